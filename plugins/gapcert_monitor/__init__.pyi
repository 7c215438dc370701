from gapcert_monitor.check import Certified as Certified
from gapcert_monitor.check import Check as Check
from gapcert_monitor.check import Monitor as Monitor
from gapcert_monitor.check import Observation as Observation
from gapcert_monitor.check import check as check
from gapcert_monitor.check import read_log as read_log
