"""Volume files of other programs, read and written."""
