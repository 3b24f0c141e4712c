"""An Alignment, for eyes."""
