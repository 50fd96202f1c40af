"""Targets of another scene among those that a field is fitted to (SysCON3D, arXiv 2605.18754)."""

from nerfdiff.distill.teacher import Teacher
from nerfdiff.distill.virtual_views import Images
from nerfdiff.utils.spread import spread


class AlienViews:
    """Give a teacher's targets, some of them replaced by views of another scene.

    Args:
        teacher: whose targets they are.
        share: of the views that are replaced, at least one; they are spread evenly.
        alien: images in [0, 1] of the other scene, of the same size; one replaces a view, in turn.
    """

    def __init__(self, teacher: Teacher, share: float, alien: Images):
        self.teacher, self.share, self.alien = teacher, share, alien

    def __getattr__(self, name: str) -> object:
        """Whatever else a teacher is asked for is the teacher's own."""
        return getattr(self.teacher, name)

    def targets(self, step: float | int, rendered: Images | None) -> Images:
        own = self.teacher.targets(step, rendered)
        images = (rendered if own is None else own).clone()  # None: the field's renderings are the targets
        replaced = replaced_views(len(images), self.share)
        chosen = [number % len(self.alien) for number in range(len(replaced))]
        images[replaced] = self.alien[chosen].to(images)
        return images


def replaced_views(views: int, share: float) -> list[int]:
    """Return the numbers of the views that are replaced, the middles of equal parts."""
    return spread(views, max(1, round(share * views)))
