"""Pictures are drawn for a full run, for several paths, and for runs that did not get far."""

import numpy as np
import pytest

from tactile_geometry import se3
from tactile_records.runs import figures
from tactile_records.runs.euler_poses import euler_sigmas
from tactile_records.runs.metrics import report
from tactile_records.runs.record import (
    ArmSeries,
    BeliefSeries,
    CommandSeries,
    GaussianSeries,
    PoseSeries,
    RunRecord,
    StageSeries,
    SurfaceMesh,
    TruthSeries,
)
from tactile_records.runs.report import write_pictures


def made_up(paths=1, seconds=3.0):
    n = round(seconds * 60)
    one = np.arange(n) / 60.0
    stamps = np.arange(n * paths, dtype=np.int64) * 16_666_667
    rng = np.random.default_rng(0)
    X_fs = np.array(
        [
            se3.pose_from_euler([0.001, 0.002, d, 0.01, 0.02, 0.0])
            for d in 0.003 + 1e-4 * rng.standard_normal(len(stamps))
        ]
    )
    T = np.tile(np.diag([-1.0, 1.0, -1.0, 1.0]), (len(stamps), 1, 1))
    for k in range(paths):
        rows = slice(k * n, (k + 1) * n)
        angle = 2 * np.pi * k / max(paths, 1) + np.pi / 2
        T[rows, 0, 3], T[rows, 1, 3] = 0.01 * one * np.cos(angle), 0.01 * one * np.sin(angle)
    T[:, 2, 3] = 0.017
    phase = np.tile(np.where(one < 0.5, "settle", np.where(one < seconds - 0.1, "follow", "retreat")), paths)
    cov = np.tile(np.diag([1e-8] * 3 + [1e-4] * 3), (len(stamps), 1, 1))
    X_sf = np.linalg.inv(X_fs)
    x, y = np.meshgrid(np.linspace(-0.05, 0.05, 9), np.linspace(-0.05, 0.05, 9))
    vertices = np.stack([x.ravel(), y.ravel(), 0.01 * x.ravel()], 1)
    index = np.arange(81).reshape(9, 9)
    faces = np.stack([index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, 1:].ravel()], 1)
    return RunRecord(
        scene="plane",
        task="surface_following",
        source="ros",
        goals=[f"path_{k}" for k in range(paths)],
        pose=PoseSeries(stamps, T),
        truth=TruthSeries(stamps, X_fs, np.zeros(len(stamps)), np.ones(len(stamps), bool)),
        estimate=GaussianSeries(stamps, X_sf, cov),
        belief=BeliefSeries(stamps, X_sf, cov),
        command=CommandSeries(
            stamps,
            twist=rng.standard_normal((len(stamps), 6)) * 0.01,
            phase=phase,
            goal=np.repeat(range(paths), n),
            reference=np.where(np.isin(phase, ("settle", "follow"))[:, None], [0, 0, 0.003, 0, 0, 0], np.nan),
        ),
        arm_twist=ArmSeries(stamps, np.zeros((len(stamps), 6))),
        latency={
            s: StageSeries(stamps, rng.uniform(a, b, len(stamps)))
            for s, a, b in (("estimator", 3e-3, 5e-3), ("controller", 5e-3, 9e-3))
        },
        surface=SurfaceMesh(vertices, faces),
    )


@pytest.mark.parametrize("paths", [1, 3])
def test_all_pictures_are_drawn(tmp_path, paths):
    written = write_pictures({"arm": made_up(paths)}, "arm", tmp_path / "out")
    assert [path.name for path in written] == ["trajectory.png", "contact.png", "twists.png", "latency.png"]
    for path in written:
        assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" and path.stat().st_size > 20_000


def test_a_run_that_recorded_nothing_gives_pictures_that_say_so(tmp_path):
    assert len(write_pictures({"arm": RunRecord(task="surface_following")}, "arm", tmp_path)) == 3


def test_a_real_run_without_truth_and_surface_is_drawn(tmp_path):
    record = made_up()
    record.truth, record.surface = TruthSeries(), SurfaceMesh()
    assert len(write_pictures({"arm": record}, "arm", tmp_path)) == 4


def test_euler_sigmas_are_those_of_sampled_poses():
    rng = np.random.default_rng(2)
    X_sf = se3.inverse(se3.pose_from_euler([0.002, -0.001, 0.003, 0.3, -0.4, 0.2]))
    half = rng.standard_normal((6, 6)) * np.array([1e-4] * 3 + [5e-3] * 3)[:, None]
    cov = half @ half.T
    sampled = [
        se3.euler_from_pose(se3.inverse(se3.exp(eps) @ X_sf))
        for eps in rng.multivariate_normal(np.zeros(6), cov, 4000)
    ]
    expected = euler_sigmas(GaussianSeries([0], X_sf[None], cov[None]))[0]
    np.testing.assert_allclose(np.std(sampled, axis=0), expected, rtol=0.06)


@pytest.mark.parametrize("late", [0.02, 0.3, 5.0])
@pytest.mark.parametrize("share", [0.002, 0.3])
def test_labels_of_the_latency_lie_inside_the_axes_whatever_the_outliers(late, share):
    record = made_up()
    seconds = np.full(1000, 0.006)
    seconds[: round(share * len(seconds))] = late
    record.latency = {"controller": StageSeries(np.arange(1000) * 16_666_667, seconds)}
    record.command = CommandSeries()  # of no phase
    with figures.style():
        figure = figures.latency(record)
        figure.draw_without_rendering()
    axes, stack = figure.axes
    frame = axes.get_window_extent()
    boxes = [text.get_window_extent() for text in axes.texts]
    assert len(boxes) == 2 and not boxes[0].overlaps(boxes[1])
    for box in boxes:
        assert frame.x0 <= box.x0 and box.x1 <= frame.x1
    hidden = late * 1e3 > stack.get_xlim()[1]
    told = f"({round(share * 1000)} of 1000 frames of the controller lie beyond" in stack.get_xlabel()
    assert told == hidden


def test_a_latency_that_was_chosen_is_not_drawn():
    record = made_up()
    record.source = "offline"
    record.latency = {"controller": StageSeries(np.arange(3), np.full(3, 0.01))}
    assert figures.latency(record) is None


def test_the_latency_that_is_drawn_is_that_of_the_report():
    record = made_up()
    seconds = record.latency["controller"].seconds
    seconds[~record.working(record.latency["controller"].stamp_ns)] = 0.4  # of the start
    p99 = report(record)["latency_ms"]["p99"]
    assert p99 < 10.0
    with figures.style():
        labels = [text.get_text() for text in figures.latency(record).axes[0].get_legend().get_texts()]
    assert any(f"p99 {p99:.1f} ms" in label for label in labels), labels
