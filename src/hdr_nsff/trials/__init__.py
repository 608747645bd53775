"""What `bench` runs, and how it tells of it."""
