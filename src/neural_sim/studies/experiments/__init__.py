"""Study ``experiments``: the page of all experiments of the paper, from finished runs."""
