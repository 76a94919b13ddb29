"""What the report says in words, and how it looks: captions, explanations, style sheet."""

CAPTIONS = {
    "exploration": (
        "The exploration as a film",
        "A time lapse; time, triangles and role exchanges are counted on top. The mover is a filled circle, the robot "
        "that stands as a landmark an empty square, and the line between them is their visual contact: it sweeps the "
        "triangles, the newest of which is darkest. Dashed lines are open gates. Robots are drawn where the smoothed "
        "estimate has them, with their 95 % ellipses enlarged as the legend says; the faint circles "
        "are where odometry alone would put them.",
    ),
    "recognition": (
        "Where the team woke up",
        "The old map, and on it in orange what the team explored before it knew where it was, at the place that "
        "explains it best; dots are corners that are the same in both. Places that explain it as well are dashed: as "
        "long as there are any, nothing is recognized.",
    ),
    "map": (
        "The map",
        "Black lines are the walls as mapped, grey ones the true walls where the truth is known; obstacles and the "
        "outside are grey. The ellipse around a vertex should hold its true position with 95 % probability. Ellipses "
        "and the lines from a mapped vertex to the true one are enlarged by the same factor, which the legend names: "
        "an honest map has about 19 of 20 such lines end inside of their ellipse. Errors of neighbouring vertices "
        "are alike, because both were seen by the same robots.",
    ),
    "trajectories": (
        "Where the robots went",
        "One panel per robot. Odometry alone drifts away, and is cut off where it leaves the picture. The causal path "
        "shows each pose as it was known at that moment, which is what the explorer steered by; the smoothed path uses "
        "all records of the run. The closer they lie to the wide grey line, the true path, the better.",
    ),
    "dual_graph": (
        "Triangulation and dual graph",
        "Each numbered or coloured dot is a triangle of free space, at its centroid; numbers tell the order of "
        "exploration. Two dots are joined when their triangles share a diagonal, by a thicker line the wider that "
        "passage is. The colour tells how well the triangle's place is known relative to the start. Around every "
        "obstacle the graph closes a loop.",
    ),
    "uncertainty": (
        "How uncertainty grows",
        "Standard deviation of each robot's position along its worst direction, as known at that moment. Left: at the "
        "last move before each role exchange, while bars or bands span all moves since the one before. Right: after "
        "every move, over the distance that all robots together have driven. A standing robot gathers no error, so "
        "uncertainty should grow with role exchanges rather than with distance; it falls when a robot meets a corner "
        "that it knows.",
    ),
    "vertex_errors": (
        "Is the map as good as it claims?",
        "Left: the error of each vertex beside three of its standard deviations; nearly all dots should lie within "
        "the shaded area, and not all of them at its bottom. Right: errors divided by what was claimed, squared "
        "(NEES), beside the distribution they have when the claim is honest. More mass on the right means too "
        "confident, more on the left too cautious. Vertices share errors, so one run scatters more "
        "than independent draws would.",
    ),
}

HOW_TO_READ = (
    (
        "Frames",
        "Everything is in the frame of the estimate: the origin is where the first robot started, x points where it "
        "looked, y to its left. Truth, where it is shown, has been moved to the true start, and nothing else was "
        "fitted in the figures and for NEES. ATE and the vertex rmse are after one rotation and translation over "
        "all points, without scale.",
    ),
    (
        "Covariances",
        "Those of map vertices are 2 × 2, along x and y of the map, in m². Those of poses are 3 × 3 along the axes of "
        "the robot itself: forward, left, heading. A sigma of a position is the standard deviation along its worst "
        "direction.",
    ),
    (
        "ATE",
        "Absolute trajectory error: root mean square of the position errors of all poses of all robots. Causal: of "
        "each pose as it was known when it was made. Heading: the same for directions.",
    ),
    (
        "NEES",
        "Normalized estimation error squared: 3 is expected of poses, 2 of vertices. Much more means too confident, "
        "much less too cautious. It is one run: only the mean over many seeds judges an estimator.",
    ),
    (
        "CRLB ratio",
        "ATE divided by the Cramér-Rao bound of the same records. No unbiased estimator is below 1 on average; a "
        "single run may be.",
    ),
    (
        "Covered and overlap",
        "Share of the true free space that the triangles cover, and that more than one covers, with the triangles put "
        "on the true vertices: they judge what was decided, not the noise. A complete triangulation has n + 2h − 2 "
        "triangles for n vertices and h holes.",
    ),
)

OUTCOMES = {  # outcome -> class of the badge, headline of the notice
    "complete": ("good", ""),
    "budget": ("fair", "The exploration was stopped before it was complete"),
    "stuck": ("bad", "The exploration got stuck and is not complete"),
}

STYLE = """
:root { --page: #f6f7f8; --card: #ffffff; --ink: #1c2126; --muted: #5b6670; --line: #d9dee2;
  --good: #00694c; --fair: #8a5a00; --bad: #a83f00; color-scheme: light dark; }
@media (prefers-color-scheme: dark) { :root { --page: #14181b; --card: #1e2428; --ink: #e7ebee; --muted: #a3aeb7;
  --line: #384148; --good: #007a59; --fair: #96640a; --bad: #b84a08; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink); font: 16px/1.5 system-ui, sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 1.5rem 1rem 4rem; }
h1 { font-size: 1.7rem; margin: 0 0 .3rem; overflow-wrap: anywhere; line-height: 1.25; }
h2 { font-size: 1.2rem; margin: 2.4rem 0 .8rem; }
p { margin: .4rem 0; overflow-wrap: anywhere; }
.muted { color: var(--muted); }
.badge { display: inline-block; color: #fff; background: #5b6670; border-radius: 1em; padding: .1em .8em;
  font-weight: 600; margin-right: .5rem; }
.badge.good { background: var(--good); } .badge.fair { background: var(--fair); } .badge.bad { background: var(--bad); }
.notice { border-left: .4rem solid var(--line); background: var(--card); padding: .6rem 1rem; margin: 1rem 0; }
.notice.fair { border-color: var(--fair); } .notice.bad { border-color: var(--bad); }
.tiles { display: grid; grid-template-columns: repeat(auto-fill, minmax(9.5rem, 1fr)); gap: .7rem; margin: 0; }
.tile { background: var(--card); border: 1px solid var(--line); border-radius: .5rem; padding: .6rem .8rem; }
.tile dt { color: var(--muted); font-size: .82rem; overflow-wrap: anywhere; }
.tile dd { margin: 0; font-size: 1.3rem; font-weight: 600; font-variant-numeric: tabular-nums; }
.tile dd small { display: block; font-size: .8rem; font-weight: 400; color: var(--muted); }
.wide { overflow-x: auto; background: var(--card); border: 1px solid var(--line); border-radius: .5rem; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: .92rem; }
th, td { padding: .4rem .7rem; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
thead th { color: var(--muted); font-weight: 600; vertical-align: bottom; white-space: normal; }
tbody tr:last-child > * { border-bottom: 0; }
tbody th { font-weight: 600; }
figure { margin: 0 0 1.8rem; }
figure img, figure video { display: block; max-width: 100%; height: auto; margin: 0 auto; }
.picture { background: #fff; border: 1px solid var(--line); border-radius: .5rem; padding: .6rem; }
figcaption { color: var(--muted); font-size: .93rem; margin-top: .5rem; max-width: 52rem; }
figcaption b { color: var(--ink); }
dl.words dt { font-weight: 600; margin-top: .7rem; } dl.words dd { margin: 0; max-width: 52rem; }
summary { cursor: pointer; font-weight: 600; padding: .4rem 0; }
@media print { body { background: #fff; } figure, .tile { break-inside: avoid; } }
"""
