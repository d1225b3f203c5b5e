"""RetinaNet as pure functions of a parameter dictionary."""
