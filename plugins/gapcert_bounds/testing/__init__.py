"""What tests of bounds need: the contracts of families and estimators, and fields whose constants are known."""
