"""A film of a logged run: the arm with the trails of ball and reference, the camera's image, the error over time.

Everything comes from the log through `servobench.harness.apps.films.replay`. Each frame is composed once and sent to
the ffmpeg of every requested film, which the optional extra `animation` installs. A film gets its name once it is
complete; until then it has a hidden name, and an interruption removes it and ends ffmpeg.
"""

import contextlib
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from pathlib import Path
from typing import IO, Any, cast

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from servobench.controllers.networks.fit import Progress
from servobench.harness.analysis.comparison import FROM_TWIN
from servobench.harness.apps.figures.responses import mark_settling_band
from servobench.harness.apps.figures.style import (
    Look,
    figure_style,
    method_styles,
    plain_logarithms,
    save_figure,
)
from servobench.harness.apps.films.replay import LoggedRun, Replay, Trail
from servobench.harness.config.installation import missing_extra
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.rendered.detection import ByteArray
from servobench.plant.robot.catalogue import DEFAULT_ROBOT, short_name
from servobench.plant.robot.workspace import BALL_RADIUS

MP4, GIF, SNAPSHOTS = KINDS = ("mp4", "gif", "snapshots")
# [px] Size of a frame; ffmpeg wants multiples of 16.
WIDTH = 960
HEIGHT = 816
HEAD = 48  # [px] height of the title, which is above both pictures
# [px] Size of the overview, which is below the title at the left.
VIEW_WIDTH = 640
VIEW_HEIGHT = 480
# [pt] Size of all words: 9 px high where a page on a telephone shows the frame 330 px wide.
TYPE = 19.0
SIDE = WIDTH - VIEW_WIDTH  # [px] width of the camera's picture, right of the overview
CAMERA_HEIGHT = 240  # [px]
MAX_RATE = 25.0  # frames a second
FINENESS = 1.25  # pixels rendered for one pixel of the overview, along each side
REFERENCE_COLOUR = (40, 40, 40)
REFERENCE_HEX = "#282828"  # the same colour
SNAPSHOT_COUNT = 8
# [1] Ways shorter than this share of the extent of the ball's path are the jitter of an arm at rest.
MIN_ADVANCE = 0.01
CROSS = 2.5 * BALL_RADIUS  # [m] half the size of the cross at a fixed target: larger than the ball
# [1] Distance, as a share of a curve's size, within which a reference counts as back at its start.
CLOSED = 0.05
GIF_WIDTH = 640  # [px]
GIF_RATE = 10  # frames a second
QUALITY = "22"  # constant rate factor of H.264: a smaller one gives a better, larger film


def write_recording(
    run: LoggedRun, stem: Path, kinds: tuple[str, ...], progress: Progress
) -> list[Path]:
    """Write the recordings of a run that are named in `kinds` into one folder, and return the files.

    Args:
        run: a logged run.
        stem: path of the files without ending.
        kinds: some of KINDS.
        progress: called with the share that is done and the name of the current step.

    Raises:
        ConfigurationError: the extra `animation` is missing, or ffmpeg cannot write.
    """
    paths = []
    films = [stem.with_name(f"{stem.name}.{kind}") for kind in kinds if kind != SNAPSHOTS]
    ffmpeg = find_ffmpeg() if films else None
    if SNAPSHOTS in kinds:
        progress(0.0, "snapshots")
        with figure_style():
            figure = draw_snapshots(run)
        paths += save_figure(figure, stem.with_name(f"{stem.name}_snapshots"))
    if ffmpeg is None:
        return paths
    stem.parent.mkdir(parents=True, exist_ok=True)
    board = _Board(run)
    time = run.track.time
    count = len(time)
    period = float(np.median(np.diff(time))) if count > 1 else 1.0
    # A frame stands for `step` periods, so that the film lasts as long as the run.
    step = max(1, round(1.0 / (MAX_RATE * period)))
    rate = 1.0 / (step * period)
    with ExitStack() as stack:
        writers = []
        for film in films:
            encoder = encoding(ffmpeg, film, (WIDTH, HEIGHT), rate)
            writers.append(stack.enter_context(encoder))
        replay = stack.enter_context(Replay(run, fineness=FINENESS))
        for k in range(0, count, step):
            progress(k / count, "frames")
            frame = board.compose(replay, k)
            for write in writers:
                write(frame)
        progress(1.0, "encoding")
    return paths + films


def find_ffmpeg() -> str:
    """Return the path of ffmpeg.

    Raises:
        ConfigurationError: there is none.
    """
    remedy = f"--kinds {SNAPSHOTS} works without it"
    try:
        package = import_module("imageio_ffmpeg")
        return str(package.get_ffmpeg_exe())
    except ImportError as error:
        raise ConfigurationError(f"{missing_extra(error, 'a film')}; {remedy}") from error
    except RuntimeError as error:
        raise ConfigurationError(f"no ffmpeg for mp4 and gif, {remedy}: {error}") from error


@contextmanager
def encoding(
    ffmpeg: str, path: Path, size: tuple[int, int], rate: float
) -> Iterator[Callable[[ByteArray], None]]:
    """Yield a function that appends a frame (height, width, 3) to the film `path`, complete when the context ends.

    Args:
        ffmpeg: the program.
        path: file of the film, ending with .mp4 or .gif.
        size: width and height of the frames [px]; even numbers for MP4.
        rate: frames a second.

    Raises:
        ConfigurationError: ffmpeg cannot write the film; with its last line.
    """
    partial = path.with_name(f".{path.stem}.partial{path.suffix}")
    width, height = size
    raw = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {rate:g} -i -".split()
    options = _options(path.suffix.removeprefix("."), rate)
    call = [ffmpeg, "-y", "-v", "error", *raw, *options, str(partial)]
    with tempfile.TemporaryFile() as complaints:
        process = subprocess.Popen(
            call,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=complaints,
            start_new_session=True,
        )
        pipe = cast("IO[bytes]", process.stdin)

        def write(frame: ByteArray) -> None:
            try:
                pipe.write(frame.tobytes())
            except OSError as error:
                raise _failure(path, process, complaints) from error

        try:
            yield write
            with contextlib.suppress(BrokenPipeError):
                pipe.close()
            if process.wait() != 0:
                raise _failure(path, process, complaints)
            partial.replace(path)
        finally:
            process.kill()  # nothing happens if it has ended
            process.wait()
            with contextlib.suppress(OSError):
                pipe.close()
            partial.unlink(missing_ok=True)


def _options(kind: str, rate: float) -> list[str]:
    if kind == MP4:
        return f"-c:v libx264 -pix_fmt yuv420p -crf {QUALITY} -preset medium -movflags +faststart".split()
    # One palette for the whole film, no dithering, and only the rectangle that changed: a still background is free.
    chain = (
        f"fps={min(float(GIF_RATE), rate):g},scale={GIF_WIDTH}:-1:flags=area,split[a][b];"
        "[a]palettegen=max_colors=128:stats_mode=full[p];[b][p]paletteuse=dither=none:diff_mode=rectangle"
    )
    return ["-filter_complex", chain, "-c:v", "gif"]


def _failure(
    path: Path, process: subprocess.Popen[bytes], complaints: IO[bytes]
) -> ConfigurationError:
    """Return the error of a failed call of ffmpeg, with the last line of its output."""
    code = process.wait()
    complaints.seek(0)
    output = complaints.read().decode(errors="replace").rstrip()
    last_line = output.rpartition("\n")[2].strip()
    reason = last_line or f"it ended with exit code {code}"
    return ConfigurationError(f"ffmpeg cannot write {path}: {reason}")


def draw_snapshots(run: LoggedRun) -> Figure:
    """Draw the arm in eight instants of its first lap, or of the whole run, at equal progress (paper, fig. 8)."""
    figure = Figure(figsize=(11.0, 4.7), layout="constrained")
    panels = figure.subplots(2, SNAPSHOT_COUNT // 2).ravel()
    for axes in panels:
        axes.set_axis_off()
    first_lap = run.ball[: _lap(run) + 1]
    instants = snapshot_instants(first_lap, SNAPSHOT_COUNT)
    with Replay(run, fineness=2.0) as replay:
        for axes, k in zip(panels, instants, strict=False):
            replay.place(k)
            axes.imshow(replay.overview(_trails(run, k)), interpolation="antialiased")
            axes.set_title(f"{run.track.time[k]:.2f} s")
    figure.suptitle(f"{_title(run)}: trail of the ball in colour, {_desired(run)} in black")
    return figure


def draw_frame(run: LoggedRun, k: int) -> ByteArray:
    """Return the frame of period `k`, (HEIGHT, WIDTH, 3)."""
    with Replay(run, fineness=2.0) as replay:
        return _Board(run).compose(replay, k)


class _Board:
    """A frame around the two pictures: its background is drawn once, the error's line and the numbers in each frame."""

    def __init__(self, run: LoggedRun) -> None:
        self._run = run
        self._colour = _colour(run)
        self._error = run.track.error()
        with figure_style():
            self._figure = Figure(figsize=(WIDTH / 100, HEIGHT / 100), dpi=100)
            self._canvas = cast("Any", FigureCanvasAgg(self._figure))
            self._write_title()
            self._axes = self._figure.add_axes((0.11, 0.1, 0.865, 0.225))
            self._prepare_axes()
            self._prepare_text()
            self._canvas.draw()
            self._background = self._canvas.copy_from_bbox(self._figure.bbox)

    def _write_title(self) -> None:
        """Write the title as large as its line allows."""
        title = self._figure.text(
            0.01,
            1 - HEAD / 2 / HEIGHT,
            _title(self._run),
            va="center",
            fontsize=TYPE,
            fontweight="bold",
        )
        width = title.get_window_extent().width
        title.set_fontsize(TYPE * min(1.0, 0.98 * WIDTH / width))

    def _prepare_text(self) -> None:
        """Write what is below the camera's picture: its title, the place of the numbers, a legend of the trails."""
        left = VIEW_WIDTH / WIDTH + 0.02
        top = 1 - (HEAD + CAMERA_HEIGHT + 10) / HEIGHT
        below: Look = {"fontsize": TYPE, "va": "top"}
        self._figure.text(left, top, "the camera's view", **below)
        self._numbers = self._figure.text(
            left,
            top - 0.06,
            "",
            family="monospace",
            animated=True,
            **below,
        )
        ball = mpl.lines.Line2D([], [], color=self._colour, linewidth=3, label="ball, so far")
        desired = mpl.lines.Line2D(
            [],
            [],
            color=REFERENCE_HEX,
            linewidth=2,
            label=_desired(self._run),
        )
        self._figure.legend(
            handles=[ball, desired],
            loc="upper left",
            bbox_to_anchor=(left - 0.015, top - 0.145),
            frameon=False,
            fontsize=TYPE,
            handlelength=1.2,
            borderpad=0.0,
            labelspacing=0.2,
        )

    def compose(self, replay: Replay, k: int) -> ByteArray:
        """Return the frame of period `k`, (HEIGHT, WIDTH, 3)."""
        replay.place(k)
        self._draw_error(k)
        frame: ByteArray = np.asarray(self._canvas.buffer_rgba())[..., :3].copy()
        overview = replay.overview(_trails(self._run, k))
        view_size = (VIEW_WIDTH, VIEW_HEIGHT)
        view = cv2.resize(overview, view_size, interpolation=cv2.INTER_AREA)
        frame[HEAD : HEAD + VIEW_HEIGHT, :VIEW_WIDTH] = view
        image = replay.camera_view()
        height, width, _ = image.shape
        scale = min(SIDE / width, CAMERA_HEIGHT / height)
        fitted = cv2.resize(image, (round(scale * width), round(scale * height)))
        height, width, _ = fitted.shape
        frame[HEAD : HEAD + height, VIEW_WIDTH : VIEW_WIDTH + width] = fitted
        return frame

    def _draw_error(self, k: int) -> None:
        """Draw the error up to period `k` and its numbers over the background."""
        time = self._run.track.time
        unit, _ = self._run.track.error_unit
        self._canvas.restore_region(self._background)
        self._line.set_data(time[: k + 1], self._error[: k + 1])
        self._now.set_data(time[k : k + 1], self._error[k : k + 1])
        self._numbers.set_text(f"time {time[k]:6.2f} s\nerror {self._error[k]:5.1f} {unit}")
        for artist in (self._line, self._now, self._numbers):
            self._figure.draw_artist(artist)

    def _prepare_axes(self) -> None:
        axes = self._axes
        track = self._run.track
        band = track.settling_band
        positive = self._error[np.isfinite(self._error) & (self._error > 0.0)]
        if len(positive):
            plain_logarithms(axes)
            # The band is NaN where the table has none: `fmin` and `fmax` then leave it out.
            low = np.fmin(0.8 * positive.min(), 0.6 * band)
            high = 1.3 * np.fmax(positive.max(), band)
            axes.set_ylim(low, high)
        first = track.time[0]
        axes.set_xlim(first, max(float(track.time[-1]), first + 1e-3))
        mark_settling_band(axes, track)
        for line in axes.get_lines():
            axes.annotate(
                str(line.get_label()),
                (0.995, band),
                xycoords=("axes fraction", "data"),
                fontsize=TYPE - 2,
                color="0.3",
                ha="right",
                va="bottom",
            )
        axes.tick_params(labelsize=TYPE - 2)
        axes.set_xlabel("time [s]", fontsize=TYPE)
        axes.set_ylabel(f"error [{track.error_unit[0]}]", fontsize=TYPE)
        (self._line,) = axes.plot([], [], color=self._colour, linewidth=1.8, animated=True)
        (self._now,) = axes.plot(
            [], [], color=self._colour, marker="o", markersize=6, animated=True
        )


def _colour(run: LoggedRun) -> str:
    name = run.track.row["controller"]
    return method_styles([name])[name].colour


def _trails(run: LoggedRun, k: int) -> list[Trail]:
    """Return the desired path, or a cross at a fixed target, and the ball's path up to period `k`."""
    red, green, blue = (round(255 * part) for part in mpl.colors.to_rgb(_colour(run)))
    # A moved camera sees the desired path at another place.
    camera_moved = k >= run.moved_from
    seen = slice(run.moved_from, None) if camera_moved else slice(run.moved_from)
    desired = run.reference[seen]
    lines = [desired]
    if run.track.point_to_point:
        lines = [desired[0] + np.stack([-arm, arm]) for arm in CROSS * np.eye(3)]
    trails = [Trail(line, REFERENCE_COLOUR, 2) for line in lines]
    trails.append(Trail(run.ball[: k + 1], (red, green, blue), 3))
    return trails


def _desired(run: LoggedRun) -> str:
    if run.track.point_to_point:
        return "target"
    return "desired path"


def snapshot_instants(ball: FloatArray, count: int) -> list[int]:
    """Return up to `count` different periods, in order, between which the ball goes equally far.

    The first is that of the start, the last that in which the ball arrives: jitter in a place adds no length.

    Args:
        ball: its path (k, 3) [m].
        count: how many periods are wanted, two or more; there are fewer if the run has fewer.
    """
    least = MIN_ADVANCE * float(np.linalg.norm(np.ptp(ball, axis=0)))
    periods = len(ball)
    count = min(count, periods)
    way = np.zeros(periods)  # [m] from the start
    place = ball[0]  # where the ball was when its way last grew
    for k in range(1, periods):
        advance = float(np.linalg.norm(ball[k] - place))
        moves = advance > least
        way[k] = way[k - 1] + advance * moves
        if moves:
            place = ball[k]
    if way[-1] == 0.0:  # the arm rests throughout
        return [round(k) for k in np.linspace(0, periods - 1, count)]
    # Rounding must not put the last instant behind the end of the way.
    wanted = np.linspace(0.0, 1.0, count) * way[-1] * (1.0 - 1e-12)
    chosen = np.searchsorted(way, wanted)
    # Where one period takes the ball far, several instants fall on it: they move to later periods,
    # and at the end of the run to earlier ones.
    order = np.arange(count)
    different = np.maximum.accumulate(chosen - order) + order
    return [int(k) for k in np.minimum(different, periods - count + order)]


def _lap(run: LoggedRun) -> int:
    """Return the period in which the reference is back where it began; the last one if it never is."""
    distance = np.linalg.norm(run.reference - run.reference[0], axis=1)
    last = len(distance) - 1
    away = np.flatnonzero(distance > 0.5 * distance.max())
    if not len(away):
        return last
    back = np.flatnonzero(distance <= CLOSED * distance.max())
    returned = back[back > away[0]]
    if len(returned):
        return int(returned[0])
    return last


def _title(run: LoggedRun) -> str:
    row = run.track.row
    plant = row["plant"]
    robot = str(row.get("robot", DEFAULT_ROBOT))
    if robot != DEFAULT_ROBOT:
        plant = f"{plant}, {short_name(robot)}"
    mismatch = row["mismatch"]
    if run.robot.twin and mismatch == "none":
        mismatch = FROM_TWIN
    return f"{row['controller']}: {row['task']} on {plant}, mismatch {mismatch}, seed {row['seed']}"
