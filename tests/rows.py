"""Rows of a batch as they might be, for whatever keeps, shows or hands them on; tests replace what matters to them."""

from __future__ import annotations

from autoalign.files.row import Row

ALIGNED = Row(
    name="a.jpg",
    fixed="reference.png",
    moving="in/a.jpg",
    status="aligned",
    reason="31 of 40 matches agree",
    expected_error_px=0.1 + 0.2,  # no number with few digits
    model="homography",
    fixed_from_moving=((1.0, 1 / 3, -2.5), (0.0, 1.1, 4e-17), (1e-7, 0.0, 1.0)),
    fixed_size=(640, 480),
    moving_size=(300, 200),
    matches=40,
    inliers=31,
    overlap=0.875,
    rung="sift",
    output="a.jpg",
    sidecar="a.jpg.autoalign.json",
)
FAILED = Row(name="b.jpg", fixed="reference.png", moving="in/b.jpg", status="failed", reason="is no picture: in/b.jpg")
