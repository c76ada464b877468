"""Error against run time: each subject writes tables, pictures and a report."""
