"""Error against run time, the evidence behind the defaults; a key of the settings is a family, in a file of its own."""
