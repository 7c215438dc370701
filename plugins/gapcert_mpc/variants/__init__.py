"""What is solved where one program for all steps is not enough."""
