"""Some of many, spread evenly."""


def spread(count: int, wanted: int | None) -> list[int]:
    """Return `wanted` of range(count), the middles of equal parts; all of them where None or too many are wanted."""
    if wanted is None or wanted >= count:
        return list(range(count))
    return [(2 * i + 1) * count // (2 * wanted) for i in range(wanted)]
