"""autoalign puts one picture onto another, without hands, and says when it cannot."""

__version__ = "0.1.0"
