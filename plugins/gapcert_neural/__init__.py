"""Neural gap functions: networks that are trained against the envelope, and lifted above it with a proof."""
