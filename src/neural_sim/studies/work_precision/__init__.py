"""Error against run time for every choice that sets a default; each file is one family of measurements."""
