"""What can go wrong, as a tree.

AutoalignError                  catch this one to catch them all
├── AlignmentError              the transform of a pair that was rejected was asked for
├── CanvasError                 a canvas that would be endless (the horizon crosses it) or larger than allowed
├── EngineError                 there is nowhere to run a batch: no worker starts, the scheduler is gone
├── ImageReadError              a file is missing, damaged, too large or no picture; the path comes last
└── ImageWriteError             a file could not be written; nothing half-written is left; the path comes last

A wrong call (shapes, dtypes, option values) is a plain ValueError.
"""


class AutoalignError(Exception):
    """Base of everything autoalign raises on purpose."""


class AlignmentError(AutoalignError):
    """The pair was rejected, so there is no transform to hand out."""


class CanvasError(AutoalignError):
    """The requested canvas is endless or too large."""


class EngineError(AutoalignError):
    """No worker can be started or reached."""


class ImageReadError(AutoalignError):
    """A file could not be read; the message gives the reason and, last, the path."""


class ImageWriteError(AutoalignError):
    """A file could not be written; the message gives the reason and, last, the path."""
