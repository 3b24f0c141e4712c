"""Arrays of pixels; knows no files."""
