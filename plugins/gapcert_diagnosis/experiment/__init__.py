"""What would tell apart what these data do not."""
