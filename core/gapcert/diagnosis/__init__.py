"""Why wrong, step by step: a recording in a model's terms, fits, screening, search, what is left, what it bought."""
