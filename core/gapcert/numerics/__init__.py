"""Numbers, files and identities: what everything else is written in."""
