from gapcert_verify.evidence import Evidence as Evidence
from gapcert_verify.evidence import bounds as bounds
from gapcert_verify.evidence import load as load
from gapcert_verify.verify import verify_run as verify_run
