"""A field of a whole captured scene, and the masks of the object in it."""
