"""A spec carried out in a folder that says what became of it."""
