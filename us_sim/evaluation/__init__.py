"""Error against run time: each subject writes a table, pictures and a report."""
