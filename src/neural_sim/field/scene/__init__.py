"""A field of a whole captured scene, and masks of the object in it."""
