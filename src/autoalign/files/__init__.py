"""Bytes to pictures and back, and what travels with them; the only room that knows codecs."""
