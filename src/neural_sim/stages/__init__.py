"""The stages of a run: one file each, which says what it needs, the key of its result, how it is made and stored."""
