"""Views of gain and bias: the equation each one states, exact round trips, and an answer published in another one."""

import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaximu.ground.errors import InputError
from jaximu.model import conventions as c

BATCHES = [(), (1,), (3, 1, 2)]


def triads(batch: tuple[int, ...], scale: float = 1.0):
    """Gains in any frame up to 0.3 rad away, with misalignment up to 0.1 and scale errors up to 20 %, and biases."""
    small = hnp.arrays(np.float64, (*batch, 3, 3), elements=st.floats(-0.1, 0.1))
    turn = hnp.arrays(np.float64, (*batch, 3), elements=st.floats(-0.3, 0.3))
    bias = hnp.arrays(np.float64, (*batch, 3), elements=st.floats(-100.0, 100.0))

    def build(small, turn, bias):
        rotation = Rotation.from_rotvec(turn.reshape(-1, 3)).as_matrix().reshape(*batch, 3, 3)
        return scale * (np.eye(3) + small) @ rotation, scale * bias

    return st.builds(build, small, turn, bias)


@st.composite
def batched_triads(draw):
    batch = draw(st.sampled_from(BATCHES))
    return draw(triads(batch, draw(st.sampled_from([1.0, 415.0, 2e-4]))))


def assert_close(actual, expected, digits=12, size=0.0):
    """Agreement to `digits` digits of the largest entry, or of `size` where that is larger."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert actual.shape == expected.shape
    atol = 10.0**-digits * max(size, np.max(np.abs(expected)))
    np.testing.assert_allclose(actual, expected, rtol=0, atol=atol)


def times(matrix, vector):
    return np.einsum("...ij,...j->...i", matrix, vector)


def diag(vector):
    return np.asarray(vector)[..., None] * np.eye(3)


# Each view's stated equation, written out once more here. Forward: output from u. Inverse: u from output.
FORWARD = {
    c.ScaleMisalignment: lambda v, u: times(diag(v.scale) @ (np.eye(3) + v.misalignment), u) + v.bias,
    c.SimplifiedScaleMisalignment: lambda v, u: times(diag(v.scale) + v.misalignment, u) + v.bias,
    c.PartsPerMillion: lambda v, u: times(np.eye(3) + 1e-6 * (diag(v.scale_error) + v.coupling), u) + v.bias,
}
INVERSE = {
    c.Tedaldi: lambda v, y: times(v.misalignment, v.scale * (y + v.bias)),
    c.ImuTk: lambda v, y: times(v.misalignment, v.scale * (y - v.bias)),
    c.ReciprocalScale: lambda v, y: times(np.linalg.inv(np.eye(3) + v.misalignment), v.reciprocal_scale * (y - v.bias)),
}
VIEWS = [*FORWARD, *INVERSE]
U = np.array([3.0, -7.0, 9.0])


@pytest.mark.parametrize("view", VIEWS)
@given(triad=batched_triads())
def test_round_trip_from_gain(view, triad):
    gain, bias = view.from_gain(*triad).to_gain()
    assert_close(gain, triad[0])
    assert_close(bias, triad[1])


@pytest.mark.parametrize("view", VIEWS)
@given(triad=batched_triads())
def test_round_trip_from_view(view, triad):
    there = view.from_gain(*triad)
    again = view.from_gain(*there.to_gain())
    # A coupling is a small difference of numbers as large as the gain: that is what its digits are counted from.
    size = {c.SimplifiedScaleMisalignment: np.max(np.abs(triad[0])), c.PartsPerMillion: 1e6 * np.max(np.abs(triad[0]))}
    for name, value in vars(there).items():
        assert_close(getattr(again, name), value, size=0.0 if name == "bias" else size.get(view, 0.0))


@pytest.mark.parametrize("view", VIEWS)
@given(triad=batched_triads())
def test_numbers_mean_the_stated_equation(view, triad):
    gain, bias = triad
    y = times(gain, U) + bias
    made = view.from_gain(gain, bias)
    if view in FORWARD:
        assert_close(FORWARD[view](made, U), y, digits=11)
    else:
        # Biases of up to 100 SI units cost two digits of u.
        assert_close(INVERSE[view](made, y), np.broadcast_to(U, y.shape), digits=11)


@pytest.mark.parametrize("view", VIEWS)
@given(triad=triads(()))
def test_shape_of_the_factors(view, triad):
    made = view.from_gain(*triad)
    if view in (c.Tedaldi, c.ImuTk):
        assert_close(np.diagonal(made.misalignment), np.ones(3), digits=15)
    else:
        off = made.coupling if view is c.PartsPerMillion else made.misalignment
        assert not np.any(np.diagonal(off))


def test_the_two_misalignments_differ_by_the_scale():
    gain = np.diag([2.0, 4.0, 5.0]) @ (np.eye(3) + 0.01 * np.triu(np.ones((3, 3)), 1))
    own = c.ScaleMisalignment.from_gain(gain, np.zeros(3))
    short = c.SimplifiedScaleMisalignment.from_gain(gain, np.zeros(3))
    np.testing.assert_allclose(np.asarray(own.misalignment)[0, 1:], 0.01, rtol=1e-14)
    np.testing.assert_allclose(short.misalignment, np.diag([2.0, 4.0, 5.0]) @ own.misalignment, rtol=1e-14)


def test_parts_per_million_of_a_known_gain():
    view = c.PartsPerMillion.from_gain(np.array([[1.001, 2e-4, 0], [0, 1, 0], [0, 0, 0.9995]]), np.zeros(3))
    np.testing.assert_allclose(view.scale_error, [1000, 0, -500], atol=1e-9)
    np.testing.assert_allclose(view.coupling, [[0, 200, 0], [0, 0, 0], [0, 0, 0]], atol=1e-12)


def test_reciprocal_scale_differs_from_the_inverse_diagonal_unless_triangular():
    full = np.eye(3) + 0.02 * (np.ones((3, 3)) - np.eye(3))
    for gain, same in [(np.tril(full), True), (np.triu(full), True), (full, False)]:
        reciprocal = c.ReciprocalScale.from_gain(gain, np.zeros(3)).reciprocal_scale
        inverse = c.Tedaldi.from_gain(gain, np.zeros(3)).scale
        assert np.allclose(reciprocal, inverse, rtol=1e-13) is same


@given(accel=triads((3, 1, 2), 415.0), gyro=triads((3, 1, 2)))
@pytest.mark.parametrize("frame", [c.lower_triangular_frame, c.upper_triangular_frame])
def test_triangular_frames(frame, accel, gyro):
    change = frame(accel[0], gyro[0])
    zeros = np.triu if frame is c.lower_triangular_frame else np.tril
    assert not np.any(zeros(np.asarray(change.gain_accel), 1 if zeros is np.triu else -1))
    assert np.all(np.diagonal(change.gain_accel, axis1=-2, axis2=-1) > 0)
    np.testing.assert_allclose(np.linalg.det(change.rotation), 1.0, rtol=1e-13)
    for new, old in [(change.gain_accel, accel[0]), (change.gain_gyro, gyro[0])]:
        assert_close(new @ change.rotation.mT, old)  # the way back is exact
        assert_close(new @ new.mT, old @ np.swapaxes(old, -1, -2))  # the invariant
    again = c.rotate_body_frame(accel[0], gyro[0], change.rotation)
    assert_close(again.gain_accel, change.gain_accel)
    assert_close(again.gain_gyro, change.gain_gyro)


def test_a_rotated_frame_sees_the_same_outputs():
    rotation = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    gain = np.eye(3) + 0.01 * np.arange(9.0).reshape(3, 3)
    new = c.rotate_body_frame(gain, gain, rotation)
    assert_close(times(new.gain_accel, rotation.T @ U), times(gain, U))  # u_old = R u_new


@pytest.mark.parametrize("batch", BATCHES)
@given(data=st.data())
def test_kalibr(batch, data):
    accel, gyro = data.draw(triads(batch)), data.draw(triads(batch, 4800.0))
    sensitivity = np.arange(9.0).reshape(3, 3) - 2.0
    k = c.Kalibr.from_gains(*accel, *gyro, sensitivity)
    assert_close(k.to_g_sensitivity(), np.broadcast_to(sensitivity, k.to_g_sensitivity().shape), digits=11)
    # IccSensors.py: M * (C_gyro_b * w_b) + Ma * (C_gyro_b * a_b), with kalibr's a_b the specific force of its frame
    f, omega = times(k.body_rotation, U), times(k.body_rotation, U[::-1])
    y_gyro = times(k.gyro_matrix, times(k.gyro_rotation, omega)) + k.gyro_bias
    y_gyro = y_gyro + times(k.g_sensitivity, times(k.gyro_rotation, f))
    assert_close(y_gyro, times(gyro[0], U[::-1]) + sensitivity @ U + gyro[1], digits=10)
    k = c.Kalibr.from_gains(*accel, *gyro)
    for actual, expected in zip(k.to_gains(), (*accel, *gyro), strict=True):
        assert_close(actual, expected)
    # kalibr's own equations in kalibr's frame give the same outputs.
    f, omega = times(k.body_rotation, U), times(k.body_rotation, U[::-1])
    assert_close(times(k.accel_matrix, f) + k.accel_bias, times(accel[0], U) + accel[1], digits=11)
    y_gyro = times(k.gyro_matrix @ k.gyro_rotation, omega) + k.gyro_bias
    assert_close(y_gyro, times(gyro[0], U[::-1]) + gyro[1], digits=11)
    for lower in (k.accel_matrix, k.gyro_matrix):
        assert not np.any(np.triu(lower, 1))
        assert np.all(np.diagonal(lower, axis1=-2, axis2=-1) > 0)
    for rotation in (k.gyro_rotation, k.body_rotation):
        assert_close(rotation @ rotation.mT, np.broadcast_to(np.eye(3), rotation.shape))
        np.testing.assert_allclose(np.linalg.det(rotation), 1.0, rtol=1e-13)


def test_kalibr_keeps_a_lower_triangular_accelerometer():
    lower = np.array([[1.01, 0, 0], [0.02, 0.99, 0], [-0.01, 0.03, 1.0]])
    k = c.Kalibr.from_gains(lower, np.zeros(3), np.eye(3), np.zeros(3))
    assert_close(k.accel_matrix, lower, digits=15)
    assert_close(k.body_rotation, np.eye(3), digits=15)


def test_kalibr_g_sensitivity_is_not_dropped_silently():
    k = c.Kalibr.from_gains(np.eye(3), np.zeros(3), np.eye(3), np.zeros(3))
    k = c.Kalibr(**{**vars(k), "g_sensitivity": 1e-4 * jnp.eye(3)})
    with pytest.raises(InputError, match="g-sensitivity"):
        k.to_gains()


# imu_tk's own answer for its Xsens recording (Kyle-ak/imu_tk), output in counts.
IMU_TK_ACCEL = c.ImuTk(
    misalignment=np.array([[1, -0.003359, -0.008906], [0, 1, -0.021334], [0, 0, 1]]),
    scale=np.array([2.412785e-3, 2.427123e-3, 2.411680e-3]),
    bias=np.array([33124.18, 33275.18, 32364.42]),
)
IMU_TK_GYRO = c.ImuTk(
    misalignment=np.array([[1, 0.005936, 0.001111], [0.008088, 1, -0.053557], [0.025307, -0.002551, 1]]),
    scale=np.array([2.092945e-4, 2.098985e-4, 2.094830e-4]),
    bias=np.array([32777.14, 32459.80, 32511.85]),
)


def test_published_answer_has_the_row_norms_of_independent_fits():
    gain, bias = IMU_TK_ACCEL.to_gain()
    norms = np.linalg.norm(gain, axis=-1)
    # Three independent nine-parameter fits: 414.42–414.48, 412.10–412.13, 414.62–414.65 counts per m/s².
    np.testing.assert_allclose(norms, [414.45, 412.115, 414.635], rtol=3e-4)
    np.testing.assert_allclose(bias, [33124.0, 33275.2, 32364.45], atol=0.3)
    # The gyroscope's factory values: a percent is all that two different calibrations of it share.
    np.testing.assert_allclose(np.linalg.norm(IMU_TK_GYRO.to_gain()[0], axis=-1), [4778, 4758, 4766], rtol=5e-3)


def test_published_answer_in_the_lower_triangular_frame():
    gain_accel, gain_gyro = IMU_TK_ACCEL.to_gain()[0], IMU_TK_GYRO.to_gain()[0]
    lower = c.lower_triangular_frame(gain_accel, gain_gyro)
    # The two conventions' body frames are 1.3° apart on this unit.
    assert np.degrees(Rotation.from_matrix(lower.rotation).magnitude()) == pytest.approx(1.3, abs=0.05)
    back = c.upper_triangular_frame(lower.gain_accel, lower.gain_gyro)
    assert_close(back.gain_accel, gain_accel)
    assert_close(back.gain_gyro, gain_gyro)
    again = c.ImuTk.from_gain(back.gain_accel, IMU_TK_ACCEL.bias)
    np.testing.assert_allclose(again.misalignment, IMU_TK_ACCEL.misalignment, atol=1e-14)
    np.testing.assert_allclose(again.scale, IMU_TK_ACCEL.scale, rtol=1e-13)


def test_published_answer_turns_the_recording_into_gravity(data_folder):
    """Sign and place of every factor at once: at rest the corrected norm is the authors' g."""
    raw = np.loadtxt(data_folder / "imu_tk_xsens" / "xsens_acc.mat")[:, 1:]
    blocks = raw[: len(raw) // 100 * 100].reshape(-1, 100, 3)
    spread = blocks.std(axis=1).max(axis=1)
    still = blocks[spread < 2 * np.quantile(spread, 0.05)].mean(axis=1)
    assert len(still) > 100

    def rms_error(answer):
        gain, bias = answer.to_gain()
        norm = np.linalg.norm(np.linalg.solve(gain, (still - bias).T), axis=0)
        return np.sqrt(np.mean((norm - 9.81744) ** 2))  # m/s²; the authors' gravity

    assert rms_error(IMU_TK_ACCEL) < 0.0025
    # The row norms above do not tell T from its other sign; the recording does.
    other_sign = 2 * np.eye(3) - np.asarray(IMU_TK_ACCEL.misalignment)
    assert rms_error(c.ImuTk(other_sign, IMU_TK_ACCEL.scale, IMU_TK_ACCEL.bias)) > 0.02


def test_first_order_inverse_is_wrong_by_the_stated_amount():
    scale = np.diag([2.0, 0.5, 1.5])
    for size in (0.02, 0.002):
        m = size * (np.ones((3, 3)) - np.eye(3))
        gain = scale @ (np.eye(3) + m)
        error = np.linalg.inv(gain) - c.first_order_inverse(gain)
        np.testing.assert_allclose(error, np.linalg.inv(np.eye(3) + m) @ m @ m @ np.linalg.inv(scale), atol=1e-15)
    assert not np.allclose(c.first_order_inverse(scale @ (np.eye(3) + 0.02)), np.linalg.inv(scale @ (np.eye(3) + 0.02)))


PERMUTED = np.eye(3)[[1, 2, 0]]
RANK_TWO = np.array([[1.0, 0, 0], [0, 1, 0], [1, 1, 1e-12]])
MIRRORED = np.diag([1.0, 1, -1])


@pytest.mark.parametrize(
    ("convert", "gain", "words"),
    [
        (lambda k: c.ScaleMisalignment.from_gain(k, np.zeros(3)), PERMUTED, "diagonal"),
        (lambda k: c.ReciprocalScale.from_gain(k, np.zeros(3)), PERMUTED, "diagonal"),
        (lambda k: c.Tedaldi.from_gain(k, np.zeros(3)), PERMUTED, "diagonal"),
        (lambda k: c.Tedaldi.from_gain(k, np.zeros(3)), RANK_TWO, "singular"),
        (lambda k: c.ImuTk.from_gain(k, np.zeros(3)), 415 * np.stack([np.eye(3), RANK_TWO]), "singular"),
        (lambda k: c.ImuTk(k, np.ones(3), np.zeros(3)).to_gain(), RANK_TWO, "singular"),
        (lambda k: c.ImuTk.from_gain(k, np.zeros(3)), np.full((3, 3), np.nan), "finite"),
        (lambda k: c.lower_triangular_frame(k, np.eye(3)), MIRRORED, "accelerometer gain is left-handed"),
        (lambda k: c.upper_triangular_frame(k, np.eye(3)), RANK_TWO, "singular"),
        (lambda k: c.Kalibr.from_gains(np.eye(3), np.zeros(3), k, np.zeros(3)), MIRRORED, "gyroscope gain is left"),
        (lambda k: c.rotate_body_frame(np.eye(3), np.eye(3), k), MIRRORED, "orthonormal"),
        (lambda k: c.rotate_body_frame(np.eye(3), np.eye(3), k), 1.001 * np.eye(3), "orthonormal"),
        (lambda k: c.first_order_inverse(k), PERMUTED, "diagonal"),
    ],
)
def test_what_a_view_cannot_express_is_refused(convert, gain, words):
    with pytest.raises(InputError, match=words):
        convert(gain)


@pytest.mark.parametrize("view", VIEWS)
def test_jit_vmap_and_derivatives(view):
    rng = np.random.default_rng(1)
    gain, bias = jnp.asarray(np.eye(3) + 0.05 * rng.normal(size=(4, 3, 3))), jnp.asarray(rng.normal(size=(4, 3)))

    def there_and_back(gain, bias):
        return view.from_gain(gain, bias).to_gain()

    for actual, expected in zip(jax.jit(jax.vmap(there_and_back))(gain, bias), (gain, bias), strict=True):
        assert_close(actual, expected)
    jacobian = jax.jacfwd(lambda k: there_and_back(k, bias[0])[0].ravel())(gain[0]).reshape(9, 9)
    assert_close(jacobian, np.eye(9), digits=11)
