"""What each command does, from files to files: one function each, for the command line and for Python."""
