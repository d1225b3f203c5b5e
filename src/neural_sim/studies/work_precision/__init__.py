"""Study ``work_precision``: error against run time, the evidence behind the defaults."""
