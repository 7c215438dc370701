"""Run folders: listed, compared and cleaned."""
