"""Many fusions at a time: the same as one after the other, whatever the instruction set."""

import numpy as np
import pytest
from fusion_cases import in_sigmas, random_pair

from tactile_filter import _fusion, se3
from tactile_filter.fusion import MODES, FusionError, fuse, fuse_batch


def instruction_sets():
    """Those that this machine has."""
    found = []
    best = _fusion.instruction_set()
    for name in ("base", "avx2", "avx512"):
        try:
            found.append(_fusion.instruction_set(name))
        except ValueError:
            continue
    _fusion.instruction_set(best)
    return found


@pytest.fixture(params=instruction_sets())
def instruction_set(request):
    best = _fusion.instruction_set()
    yield _fusion.instruction_set(request.param)
    _fusion.instruction_set(best)


def stacked(count, separation=4.0):
    pairs = [random_pair(seed, separation) for seed in range(count)]
    return [np.stack(column) for column in zip(*pairs, strict=True)]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("count", [0, 1, 3, 16, 21])
def test_a_batch_is_the_single_fusions_to_the_bit(instruction_set, mode, count):
    columns = stacked(count) if count else [np.empty((0, k, k)) for k in (4, 6, 4, 6)]
    batch = fuse_batch(*columns, mode)
    assert batch.mean.shape == (count, 4, 4)
    for n in range(count):
        single = fuse(*(column[n] for column in columns), mode)
        np.testing.assert_array_equal(batch.mean[n], single.mean)
        np.testing.assert_array_equal(batch.cov[n], single.cov)
        np.testing.assert_array_equal(batch.factor[n], single.factor)
        assert batch.step[n] == single.step
        assert batch.status[n] == single.status


def test_lanes_that_need_another_way_do_not_disturb_their_neighbors(instruction_set):
    columns = stacked(16)
    # far apart; nearly singular; both leave the vectors' path
    columns[2][3] = se3.exp([0.1, 0.0, 0.0, 2.5, 0.5, 0.3]) @ columns[0][3]
    columns[1][6] = np.eye(6) + (1.0 - 1e-10) * (np.eye(6)[::-1])
    batch = fuse_batch(*columns)
    for n in range(16):
        single = fuse(*(column[n] for column in columns))
        np.testing.assert_array_equal(batch.mean[n], single.mean)
        np.testing.assert_array_equal(batch.cov[n], single.cov)


def test_all_instruction_sets_with_fma_agree_to_the_bit_and_the_base_to_rounding():
    columns, best = stacked(24), _fusion.instruction_set()
    results = {}
    for name in instruction_sets():
        _fusion.instruction_set(name)
        results[name] = fuse_batch(*columns)
    _fusion.instruction_set(best)
    if "avx512" in results:
        np.testing.assert_array_equal(results["avx512"].mean, results["avx2"].mean)
        np.testing.assert_array_equal(results["avx512"].cov, results["avx2"].cov)
    for n in range(24):
        base, other = results["base"], results[best]
        assert in_sigmas(base.mean[n], other.mean[n], base.cov[n]) <= 1e-12


def test_single_precision_is_single_precision():
    columns = [column.astype(np.float32) for column in stacked(20, separation=2.0)]
    batch = fuse_batch(*columns)
    assert batch.mean.dtype == batch.cov.dtype == np.float32
    exact = fuse_batch(*(column.astype(np.float64) for column in columns))
    for n in range(20):
        assert in_sigmas(batch.mean[n].astype(np.float64), exact.mean[n], exact.cov[n]) <= 5e-3
        scale = np.sqrt(np.outer(np.diag(exact.cov[n]), np.diag(exact.cov[n])))
        assert np.abs((batch.cov[n] - exact.cov[n]) / scale).max() <= 2e-4


def test_the_first_pair_that_cannot_be_fused_is_named():
    columns = stacked(12)
    columns[3][7] = np.diag([1.0, 1, 1, 1, 1, -2])
    with pytest.raises(FusionError, match=r"cov_2\[7\]: is not positive definite: smallest eigenvalue -2,"):
        fuse_batch(*columns)
    columns[0][2, 0, 0] = np.nan
    with pytest.raises(FusionError, match=r"mean_1\[2\]: is not finite"):
        fuse_batch(*columns)


def test_an_answer_can_be_overwritten_by_the_next():
    columns, others = stacked(9), stacked(9, separation=1.0)
    out = fuse_batch(*others)
    assert fuse_batch(*columns, out=out) is out
    np.testing.assert_array_equal(out.mean, fuse_batch(*columns).mean)
    with pytest.raises(ValueError, match="out: must be of 4 pairs, is of 9"):
        fuse_batch(*(column[:4] for column in columns), out=out)
    with pytest.raises(ValueError, match="needs contiguous arrays of one type"):
        fuse_batch(*(column.astype(np.float32) for column in columns), out=out)
    out.cov.flags.writeable = False
    with pytest.raises(ValueError, match="out is read-only"):
        fuse_batch(*columns, out=out)


def test_shapes_and_instruction_sets_that_are_not_there_are_named():
    columns = stacked(3)
    with pytest.raises(ValueError, match=r"cov_1: must have shape \(3, 6, 6\), has \(2, 6, 6\)"):
        fuse_batch(columns[0], columns[1][:2], *columns[2:])
    with pytest.raises(ValueError, match="instruction set 'mmx': this machine does not have it"):
        _fusion.instruction_set("mmx")


@pytest.mark.parametrize("mode", MODES)
def test_errors_of_fused_poses_are_as_large_as_their_covariances_claim(mode):
    rng, count = np.random.default_rng(4), 20000
    truth, cov_1, _, cov_2 = random_pair(1)
    covs = [cov_1, cov_2]
    means = []
    for cov in covs:
        # truth = exp(eps^) mean
        eps = rng.normal(size=(count, 6)) @ np.linalg.cholesky(cov).T
        means.append(np.stack([se3.exp(-e) @ truth for e in eps]))
    stacks = [np.broadcast_to(cov, (count, 6, 6)) for cov in covs]
    fused = fuse_batch(means[0], stacks[0], means[1], stacks[1], mode)
    errors = np.stack([se3.log(truth @ se3.inverse(mean)) for mean in fused.mean])
    whitened = np.linalg.solve(fused.factor, errors[:, :, None])[:, :, 0]
    # standard normal: the mean square of 20000 is 1 within 1 %, correlations vanish
    np.testing.assert_allclose(whitened.T @ whitened / count, np.eye(6), atol=0.045)
    assert (whitened**2).sum(axis=1).mean() == pytest.approx(6.0, abs=0.1)
