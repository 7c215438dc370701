"""YAML with places, and specs that extend others."""
