"""Two pictures in, one Alignment out."""
