"""HTML pages, among them report.html, which says whether a run worked."""
