"""Run folders: listed, compared, cleaned, watched."""
