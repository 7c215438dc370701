from gapcert_diagnosis.diagnose import diagnose as diagnose
