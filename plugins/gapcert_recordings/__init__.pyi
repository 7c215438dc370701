from gapcert_recordings.experiment import play as play
