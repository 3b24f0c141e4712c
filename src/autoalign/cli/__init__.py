"""The command line: parse, call, print, exit code; no image work."""
