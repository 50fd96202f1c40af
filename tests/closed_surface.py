from collections import Counter

import numpy as np


def assert_closed(part):
    """Every directed edge occurs once and its reverse once: no holes, no flipped faces."""
    edges = Counter()
    for face in part.faces:
        edges.update(zip(face, np.roll(face, -1), strict=True))
    assert set(edges.values()) == {1}, part.name
    assert all((b, a) in edges for a, b in edges), part.name
    assert part.volume() > 0, part.name
