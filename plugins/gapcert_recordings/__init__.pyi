from gapcert_recordings.experiment import play as play
from gapcert_recordings.inspect import Table as Table
from gapcert_recordings.inspect import inspect as inspect
from gapcert_recordings.transitions import Transitions as Transitions
from gapcert_recordings.transitions import axes as axes
