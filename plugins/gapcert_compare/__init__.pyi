from gapcert_compare.compare import Comparison as Comparison
from gapcert_compare.compare import closed as closed
