"""The sections of a spec, the core's own and those that plugins contribute."""
