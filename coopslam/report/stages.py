"""The moments of a run that tell its story: the rows of the paper's figure 3, chosen from the log by what they mean."""

from dataclasses import dataclass

from coopslam.report.story import Story, sides_of

ROWS = 5
EARLY, SECOND = 3, 6  # the paper shows the third and the sixth triangle


@dataclass(frozen=True, slots=True)
class Stage:
    """A moment right after a triangle was decided."""

    title: str
    time_s: float
    triangles: int


def choose_stages(story: Story) -> list[Stage]:
    """Early, the sixth triangle, a bifurcation, a later stage and the end; fewer when fewer triangles were found."""
    found = list(story.triangles.values())
    total = len(found)
    titles = {EARLY: "early phase", SECOND: "one triangle at a time"}
    fork = bifurcation(story)
    if fork is not None:
        titles[fork] = "the graph bifurcates"
    so_far = max((count for count in titles if count < total), default=0)
    titles.setdefault((so_far + total) // 2, "later stage")
    titles = {count: title for count, title in titles.items() if 0 < count < total}
    for k in range(1, ROWS):  # a small world: what is missing is taken evenly from the rest
        if len(titles) < min(ROWS, total) - 1:
            titles.setdefault(max(k * total // ROWS, 1), "on the way")
    stages = [Stage(titles[count], found[count - 1].stamp_s, count) for count in sorted(titles) if count < total]
    last = "complete" if not story.gates_at(story.end_s) else "the end, with open gates"
    return [*stages, Stage(last, story.end_s, total)]


def bifurcation(story: Story) -> int | None:
    """After how many triangles the graph first bifurcates: a triangle without known walls leaves two open gates.

    The paper's example comes after the sixth triangle; an earlier one is taken only when there is no such.
    """
    forks = []
    for count, found in enumerate(story.triangles.values(), start=1):
        walls = set(story.walls_at(found.stamp_s))
        gates = set(story.gates_at(found.stamp_s))
        sides = sides_of(found.vertices)
        if not walls.intersection(sides) and sum((b, a) in gates for a, b in sides) == 2:
            forks.append(count)
    return next((count for count in forks if count > SECOND), forks[0] if forks else None)
