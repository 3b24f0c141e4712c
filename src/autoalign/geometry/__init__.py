"""Points and 3x3 transforms in pure NumPy; knows no pixels."""
