"""report.html: one page that says whether a run worked."""
