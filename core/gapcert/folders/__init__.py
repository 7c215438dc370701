"""Run folders: what happened in them, who runs in them, and what may be done with them."""
