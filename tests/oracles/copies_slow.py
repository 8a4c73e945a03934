"""Groups of like pictures the slow way: every pair compared, groups grown by flooding."""

from collections.abc import Callable


def flood(count: int, are_alike: Callable[[int, int], bool]) -> list[set[int]]:
    """Sets of more than one, in the order of their first member."""
    left, groups = set(range(count)), []
    for start in range(count):
        if start not in left:
            continue
        group, edge = {start}, [start]
        while edge:
            here = edge.pop()
            new = {other for other in left - group if are_alike(min(here, other), max(here, other))}
            group |= new
            edge += new
        left -= group
        if len(group) > 1:
            groups.append(group)
    return groups
