from gapcert_bounds.families.multilinear import MultilinearPredictor as MultilinearPredictor
from gapcert_bounds.families.stored import calibrated as calibrated
from gapcert_bounds.families.stored import stored as stored
