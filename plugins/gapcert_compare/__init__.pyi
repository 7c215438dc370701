from gapcert_compare.compare import Comparison as Comparison
