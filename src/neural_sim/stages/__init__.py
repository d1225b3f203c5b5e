"""The stages of a run: one file each, with its inputs, the key of its result, and how that is computed and stored."""
