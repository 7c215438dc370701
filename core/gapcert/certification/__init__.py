"""What makes a claim true. Read `certify.py` first."""
