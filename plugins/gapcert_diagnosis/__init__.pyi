from gapcert_diagnosis.diagnose import diagnose as diagnose
from gapcert_diagnosis.results import ORDER as ORDER
from gapcert_diagnosis.results import Cause as Cause
from gapcert_diagnosis.results import Diagnosis as Diagnosis
from gapcert_diagnosis.results import Estimate as Estimate
from gapcert_diagnosis.results import Gain as Gain
from gapcert_diagnosis.testing import EffectContract as EffectContract
