"""From rendered objects to labelled training images."""
