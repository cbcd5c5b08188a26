"""A film of a logged run: the arm with the trails of ball and reference, the camera's image, the error over time.

Everything comes from the log through `servobench.harness.pictures.replay`. Each frame is composed once and sent to the
ffmpeg of every requested film, which the optional extra `animation` installs. A film gets its name once it is complete;
until then it has a hidden name, and an interruption removes it and ends ffmpeg.
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
from servobench.harness.config.installation import missing_extra
from servobench.harness.pictures.replay import LoggedRun, Replay, Trail
from servobench.harness.pictures.responses import mark_settling_band
from servobench.harness.pictures.style import (
    figure_style,
    method_styles,
    plain_logarithms,
    save_figure,
)
from servobench.harness.run.request import DEFAULT_ROBOT, short_name
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.rendered.detection import ByteArray
from servobench.plant.robot.workspace import BALL_RADIUS

MP4, GIF, SNAPSHOTS = KINDS = ("mp4", "gif", "snapshots")
WIDTH, HEIGHT = 960, 816  # px of a frame; ffmpeg wants multiples of 16
# Px: line of text on top, overview below it at the left
HEAD, VIEW_WIDTH, VIEW_HEIGHT = (48, 640, 480)
TYPE = 19.0  # [pt] of all words: 9 px high where a page on a telephone shows the frame 330 px wide
SIDE = WIDTH - VIEW_WIDTH
CAMERA_HEIGHT = 240  # px
MAX_RATE = 25.0  # frames a second
FINENESS = 1.25  # pixels rendered for one pixel of the overview, along each side
REFERENCE_COLOUR, REFERENCE_HEX = (40, 40, 40), "#282828"
SNAPSHOT_COUNT = 8
MIN_ADVANCE = (
    0.01  # of the extent of the ball's path: shorter ways are the jitter of an arm at rest
)
CROSS = 2.5 * BALL_RADIUS  # [m] half of its size at a fixed target: larger than the ball
CLOSED = 0.05  # share of a curve's size, within which its reference counts as back at its start
GIF_WIDTH, GIF_RATE = 640, 10  # px, frames a second
QUALITY = "22"  # of H.264: smaller is better and larger


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
    board, time = _Board(run), run.track.time
    count, period = len(time), float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    # Periods from frame to frame; the film lasts as long as the run
    step = max(1, round(1.0 / (MAX_RATE * period)))
    rate = 1.0 / (step * period)
    with ExitStack() as stack:
        writers = [
            stack.enter_context(encoding(ffmpeg, film, (WIDTH, HEIGHT), rate)) for film in films
        ]
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
        package: Any = import_module("imageio_ffmpeg")
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
        path: of the film, ending with .mp4 or .gif.
        size: width and height of the frames [px]; even numbers for MP4.
        rate: frames a second.

    Raises:
        ConfigurationError: ffmpeg cannot write the film; with its last line.
    """
    partial = path.with_name(f".{path.stem}.partial{path.suffix}")
    raw = [
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-s",
        f"{size[0]}x{size[1]}",
        "-r",
        f"{rate:g}",
        "-i",
        "-",
    ]
    call = [
        ffmpeg,
        "-y",
        "-v",
        "error",
        *raw,
        *_options(path.suffix.removeprefix("."), rate),
        str(partial),
    ]
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
    last = complaints.read().decode(errors="replace").rstrip().rpartition("\n")[2].strip()
    return ConfigurationError(
        f"ffmpeg cannot write {path}: {last or f'it ended with exit code {code}'}"
    )


def draw_snapshots(run: LoggedRun) -> Figure:
    """Draw the arm in eight instants of its first lap, or of the whole run, at equal progress (paper, fig. 8)."""
    figure = Figure(figsize=(11.0, 4.7), layout="constrained")
    panels = figure.subplots(2, SNAPSHOT_COUNT // 2).ravel()
    for axes in panels:
        axes.set_axis_off()
    with Replay(run, fineness=2.0) as replay:
        for axes, k in zip(
            panels, snapshot_instants(run.ball[: _lap(run) + 1], SNAPSHOT_COUNT), strict=False
        ):
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
        self._run, self._colour, self._error = run, _colour(run), run.track.error()
        with figure_style():
            self._figure = figure = Figure(figsize=(WIDTH / 100, HEIGHT / 100), dpi=100)
            self._canvas = cast("Any", FigureCanvasAgg(figure))
            title = figure.text(
                0.01,
                1 - HEAD / 2 / HEIGHT,
                _title(run),
                va="center",
                fontsize=TYPE,
                fontweight="bold",
            )
            title.set_fontsize(TYPE * min(1.0, 0.98 * WIDTH / title.get_window_extent().width))
            self._axes = figure.add_axes((0.11, 0.1, 0.865, 0.225))
            self._prepare_axes()
            left, top = VIEW_WIDTH / WIDTH + 0.02, 1 - (HEAD + CAMERA_HEIGHT + 10) / HEIGHT
            below: dict[str, Any] = {"fontsize": TYPE, "va": "top"}
            figure.text(left, top, "the camera's view", **below)
            self._numbers = figure.text(
                left, top - 0.06, "", family="monospace", animated=True, **below
            )
            lines = [
                mpl.lines.Line2D([], [], color=self._colour, linewidth=3, label="ball, so far"),
                mpl.lines.Line2D([], [], color=REFERENCE_HEX, linewidth=2, label=_desired(run)),
            ]
            figure.legend(
                handles=lines, loc="upper left", bbox_to_anchor=(left - 0.015, top - 0.145), frameon=False,
                fontsize=TYPE, handlelength=1.2, borderpad=0.0, labelspacing=0.2,
            )  # fmt: skip
            self._canvas.draw()
            self._background = self._canvas.copy_from_bbox(figure.bbox)

    def compose(self, replay: Replay, k: int) -> ByteArray:
        """Return the frame of period `k`, (HEIGHT, WIDTH, 3)."""
        run = self._run
        replay.place(k)
        self._canvas.restore_region(self._background)
        time = run.track.time
        self._line.set_data(time[: k + 1], self._error[: k + 1])
        self._now.set_data(time[k : k + 1], self._error[k : k + 1])
        self._numbers.set_text(
            f"time {time[k]:6.2f} s\nerror {self._error[k]:5.1f} {run.track.error_unit[0]}"
        )
        for artist in (self._line, self._now, self._numbers):
            self._figure.draw_artist(artist)
        frame: ByteArray = np.asarray(self._canvas.buffer_rgba())[..., :3].copy()
        view = cv2.resize(
            replay.overview(_trails(run, k)),
            (VIEW_WIDTH, VIEW_HEIGHT),
            interpolation=cv2.INTER_AREA,
        )
        frame[HEAD : HEAD + VIEW_HEIGHT, :VIEW_WIDTH] = view
        raw = replay.camera_view()
        scale = min(SIDE / raw.shape[1], CAMERA_HEIGHT / raw.shape[0])
        seen = cv2.resize(raw, (round(scale * raw.shape[1]), round(scale * raw.shape[0])))
        frame[HEAD : HEAD + seen.shape[0], VIEW_WIDTH : VIEW_WIDTH + seen.shape[1]] = seen
        return frame

    def _prepare_axes(self) -> None:
        axes, track, band = self._axes, self._run.track, self._run.track.settling_band
        positive = self._error[np.isfinite(self._error) & (self._error > 0.0)]
        if len(positive):
            plain_logarithms(axes)
            axes.set_ylim(
                np.fmin(0.8 * positive.min(), 0.6 * band), 1.3 * np.fmax(positive.max(), band)
            )
        axes.set_xlim(track.time[0], max(float(track.time[-1]), track.time[0] + 1e-3))
        mark_settling_band(axes, track)
        for line in axes.get_lines():
            axes.annotate(str(line.get_label()), (0.995, band), xycoords=("axes fraction", "data"), fontsize=TYPE - 2,
                          color="0.3", ha="right", va="bottom")  # fmt: skip
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
    desired = (
        run.reference[run.moved_from :] if k >= run.moved_from else run.reference[: run.moved_from]
    )
    cross = [desired[0] + np.stack([-arm, arm]) for arm in CROSS * np.eye(3)]
    lines = cross if run.track.point_to_point else [desired]
    return [
        *(Trail(line, REFERENCE_COLOUR, 2) for line in lines),
        Trail(run.ball[: k + 1], (red, green, blue), 3),
    ]


def _desired(run: LoggedRun) -> str:
    return "target" if run.track.point_to_point else "desired path"


def snapshot_instants(ball: FloatArray, count: int) -> list[int]:
    """Return up to `count` different periods, in order, between which the ball goes equally far.

    The first is that of the start, the last that in which the ball arrives: jitter in a place adds no length.

    Args:
        ball: its path (k, 3) [m].
        count: how many periods are wanted, two or more; there are fewer if the run has fewer.
    """
    least = MIN_ADVANCE * float(np.linalg.norm(np.ptp(ball, axis=0)))
    way, place, count = np.zeros(len(ball)), ball[0], min(count, len(ball))
    for k, point in enumerate(ball):
        advance = float(np.linalg.norm(point - place))
        counts = advance > least
        way[k] = way[k - 1] + advance * counts if k else 0.0
        place = point if counts else place
    if way[-1] == 0.0:  # the arm rests throughout
        return [round(k) for k in np.linspace(0, len(ball) - 1, count)]
    order = np.arange(count)
    chosen = np.searchsorted(way, np.linspace(0.0, 1.0, count) * way[-1] * (1.0 - 1e-12))
    apart = np.maximum.accumulate(chosen - order) + order  # where one period takes the ball far
    return [int(k) for k in np.minimum(apart, len(ball) - count + order)]


def _lap(run: LoggedRun) -> int:
    """Return the period in which the reference is back where it began; the last one if it never is."""
    distance = np.linalg.norm(run.reference - run.reference[0], axis=1)
    away = np.flatnonzero(distance > 0.5 * distance.max())
    back = np.flatnonzero(distance <= CLOSED * distance.max())
    after = back[back > away[0]] if len(away) else back[:0]
    return int(after[0]) if len(after) else len(distance) - 1


def _title(run: LoggedRun) -> str:
    row = run.track.row
    robot = str(row.get("robot", DEFAULT_ROBOT))
    arm = "" if robot == DEFAULT_ROBOT else f", {short_name(robot)}"
    mismatch = FROM_TWIN if run.robot.twin and row["mismatch"] == "none" else row["mismatch"]
    return f"{row['controller']}: {row['task']} on {row['plant']}{arm}, mismatch {mismatch}, seed {row['seed']}"
