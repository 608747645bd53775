"""What `evaluate` measures, one kind of error a file."""
