"""The recording in the model's terms."""
