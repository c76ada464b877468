"""Error against run time: each subject writes tables, pictures and a report.

Each subject has a function that is called with the folder to write to, which is made if it is not
there, and with whether a part of it, in a few minutes, will do. It prints a table, and returns 0,
or 1 where something failed: that has a row that says how, and the rest is measured all the same.
It raises UsSimError where the folder cannot be written or holds a report, before anything is
measured.
"""
