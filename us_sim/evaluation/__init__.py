"""Error against run time: each subject writes tables, pictures and a report.

A subject is a folder with cases, measure, report and templates. Its function takes the folder to
write to, made if it is not there, and whether it is a quick run of a few minutes. It prints a table
and returns 0, or 1 where something failed: its row says how, and the rest is measured all the same.
It raises UsSimError, before anything is measured, where the folder cannot be written or holds a
report.
"""
