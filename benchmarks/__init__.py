"""Evidence: accuracy, run time and stability, each by one command (see README.md)."""
