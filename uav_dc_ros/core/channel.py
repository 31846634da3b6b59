"""Channel models: the path gain between the UAV and the users on the ground. `radio.model` names one.

`free_space`     the paper's eq. 2
`air_to_ground`  free space and an excess loss, with and without line of sight, whose probability grows with
                 the elevation. Al-Hourani, Kandeepan, Lardner, "Optimal LAP Altitude for Maximum Coverage",
                 IEEE Wireless Communications Letters 3(6), 2014
`gain_map`       path gains from a table: see `gain_map`
`tr_36_777`      3GPP TR 36.777 V15.0.0, "Enhanced LTE support for aerial vehicles", Annex B, Tables B-1 to 3

Each may have shadowing and fading, and the models with a line of sight may draw it: see `stochastic`.
docs/channels.md writes the formulas out, and states what this project assumes.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, TypeAlias

import msgspec
from msgspec import Meta

from uav_dc_ros.core import radio
from uav_dc_ros.core.arrays import Array, array_namespace, constant
from uav_dc_ros.core.grid import Grid
from uav_dc_ros.core.propagation import gain_map, stochastic
from uav_dc_ros.core.propagation.stochastic import Fading, Realization, Shadowing
from uav_dc_ros.core.radio import Interference
from uav_dc_ros.core.users.settings import UserSettings

# A link with and without line of sight. `mean_loss_db`: the mean of the losses in dB, as in the letter.
# `mean_gain`: that of the linear gains, which gives the mean received power. `drawn`: one of both, by a draw
# for each user and step.
LineOfSight: TypeAlias = Literal["mean_loss_db", "mean_gain", "drawn"]
Positive: TypeAlias = Annotated[float, Meta(gt=0)]
CarrierHz: TypeAlias = Annotated[float, Meta(ge=1e8, le=1e11)]

SPEED_OF_LIGHT_MPS = 299_792_458.0


class RadioSettings(
    msgspec.Struct,
    frozen=True,
    forbid_unknown_fields=True,
    kw_only=True,
    omit_defaults=True,
    tag_field="model",
):
    """The uplink: keys of every model."""

    bandwidth_hz: Positive  # bandwidth B, hertz
    tx_power_w: Positive  # transmit power p of a user, watts
    noise_power_dbm: Annotated[float, Meta(ge=-300, le=100)]  # noise power alpha^2, dBm
    shadowing: Shadowing | None = None  # none without the table
    fading: Fading | None = None  # none without the table; `fading.model` names one

    @property
    def draws_links(self) -> bool:
        """Whether each step draws the line of sight or the fading of each link."""
        return self.fading is not None or getattr(self, "line_of_sight", None) == "drawn"

    @property
    def is_random(self) -> bool:
        """Whether the channel draws anything."""
        return self.shadowing is not None or self.draws_links

    @property
    def noise_power_w(self) -> float:
        """Noise power, watts."""
        return 10.0 ** (self.noise_power_dbm / 10.0) * 1e-3


class FreeSpace(RadioSettings, frozen=True, omit_defaults=True, tag="free_space"):
    """The paper's channel: a line-of-sight link (eq. 2)."""

    ref_gain_db: Annotated[float, Meta(ge=-200, le=100)]  # channel power gain beta_0 at 1 m, dB
    path_loss_exponent: Annotated[float, Meta(ge=1, le=10)]  # exponent of the path loss
    interference: Interference  # transmitting users, see `radio.sinr`
    # Loss of a link that a building cuts, dB; only for a scenario with buildings
    obstruction_loss_db: Annotated[float, Meta(ge=0, le=200)] | None = None

    @property
    def ref_gain(self) -> float:
        """Channel power gain at 1 m, linear."""
        return 10.0 ** (self.ref_gain_db / 10.0)


class AirToGround(RadioSettings, frozen=True, tag="air_to_ground"):
    """Line of sight with a probability that grows with the elevation; see `air_to_ground_sight`."""

    carrier_hz: CarrierHz  # carrier frequency, hertz; the excess losses were published for 2 GHz
    environment: Literal["suburban", "urban", "dense_urban", "high_rise"]  # see `ENVIRONMENTS`
    line_of_sight: LineOfSight  # how a link with and without line of sight counts, see `mean_gain`
    interference: Interference  # transmitting users, see `radio.sinr`


class AerialVehicle(RadioSettings, frozen=True, tag="tr_36_777"):
    """3GPP's model for aerial vehicles; see `aerial_vehicle_sight`."""

    carrier_hz: CarrierHz  # carrier frequency, hertz; 3GPP evaluated 0.7 GHz (RMa-AV) and 2 GHz
    environment: Literal["rma_av", "uma_av", "umi_av"]  # rural macro, urban macro, urban micro; see `AERIAL`
    line_of_sight: LineOfSight  # how a link with and without line of sight counts, see `mean_gain`
    interference: Interference  # transmitting users, see `radio.sinr`


class GainMap(RadioSettings, frozen=True, tag="gain_map"):
    """Path gains from a table; see `gain_map.gain_db`."""

    file: str  # of the table, `.npz`; in a scenario's file relative to its folder, here absolute
    interference: Interference  # transmitting users, see `radio.sinr`
    sha256: str = ""  # of the file's content, hexadecimal; `scenarios.load` works it out where it is missing


Radio: TypeAlias = FreeSpace | AirToGround | AerialVehicle | GainMap


class Environment(NamedTuple):
    """Parameters of `air_to_ground` in one environment."""

    a: float  # of the probability of line of sight, degrees
    b: float  # likewise, 1 / degree
    excess_los_db: float  # loss beyond free space with line of sight
    excess_nlos_db: float  # and without


# a and b follow from the letter's polynomials (its Table I) with the alpha, beta and gamma of ITU-R P.1410,
# (0.1, 750, 8), (0.3, 500, 15), (0.5, 300, 20) and (0.5, 300, 50). They are rounded as in Bor-Yaliniz,
# El-Keyi, Yanikomeroglu, "Efficient 3-D placement of an aerial base station", ICC 2016. The excess losses
# are those at 2 GHz of Al-Hourani, Kandeepan, Jamalipour, "Modeling air-to-ground path loss for low altitude
# platforms in urban environments", GLOBECOM 2014, which the letter takes.
ENVIRONMENTS = {
    "suburban": Environment(4.88, 0.43, 0.1, 21.0),
    "urban": Environment(9.61, 0.16, 1.0, 20.0),
    "dense_urban": Environment(12.08, 0.11, 1.6, 23.0),
    "high_rise": Environment(27.23, 0.08, 2.3, 34.0),
}


class Aerial(NamedTuple):
    """Range, line of sight and shadowing of one environment of TR 36.777, tables B-1 and B-3.

    p1 = max(p1_slope log10(h) + p1_offset, p1_min), d1 = max(d1_slope log10(h) + d1_offset, 18), metres, and
    with line of sight sigma = max(sigma_los_db exp(-sigma_los_per_m h), sigma_los_min_db); h is the height,
    metres.
    """

    min_height_m: float  # the UAV flies above it; below, the table refers to users on the ground
    max_ground_distance_m: float  # greatest horizontal distance (Table B-2)
    p1_slope: float
    p1_offset: float
    p1_min: float
    d1_slope: float
    d1_offset: float
    certain_above_m: float  # height above which line of sight is certain
    sigma_los_db: float
    sigma_los_per_m: float
    sigma_los_min_db: float
    sigma_nlos_db: float  # standard deviation of the shadowing without line of sight


AERIAL_MAX_HEIGHT_M = 300.0
AERIAL = {
    "rma_av": Aerial(10.0, 10_000.0, 15021.0, -16053.0, 1000.0, 1350.8, -1602.0, 40.0, 4.2, 0.0046, 0.0, 6.0),
    "uma_av": Aerial(22.5, 4000.0, 4300.0, -3800.0, 0.0, 460.0, -700.0, 100.0, 4.64, 0.0066, 0.0, 6.0),
    "umi_av": Aerial(22.5, 4000.0, 233.98, -0.95, 0.0, 294.05, -432.94, math.inf, 5.0, 0.01, 2.0, 8.0),
}


class Sight(NamedTuple):
    """A link with and without line of sight, each `[..., U]`."""

    probability: Array  # of line of sight
    los_db: Array  # path loss with line of sight
    nlos_db: Array  # path loss without


def title(values: Radio) -> str:
    """The channel in words: `free_space`, or `air_to_ground, urban, 2 GHz`."""
    parts = [str(values.__struct_config__.tag)]
    if isinstance(values, GainMap):
        parts += [Path(values.file).name]
    elif not isinstance(values, FreeSpace):
        parts += [values.environment, f"{values.carrier_hz / 1e9:g} GHz"]
        parts += ["line of sight drawn"] * (values.line_of_sight == "drawn")
    parts += ["shadowing"] * (values.shadowing is not None)
    if values.fading is not None:
        parts.append(f"{values.fading.__struct_config__.tag} fading")
    return ", ".join(parts)


def path_gain(
    values: Radio,
    uav_m: Array,
    users_m: Array,
    distance_m: Array,
    drawn: Realization | None = None,
    cut: Array | None = None,
) -> Array:
    """Channel power gain, linear, `[..., U]`.

    The UAV is at `uav_m` `[..., 3]`, the users on the ground at `users_m` `[..., U, 2]`, and `distance_m`
    `[..., U]` is their 3D distance, metres. Without what the channel has `drawn`, the gain is that without
    shadowing and fading, and a line of sight that is to be drawn counts as in `mean_gain`.
    A link that a building cuts (`cut`, bool `[..., U]`) loses `obstruction_loss_db` more in free space, and
    has no line of sight in the models with one; a gain map has the buildings in it.
    """
    if isinstance(values, FreeSpace | GainMap):
        if isinstance(values, FreeSpace):
            gain = radio.path_gain(distance_m, values.ref_gain, values.path_loss_exponent)
            gain = gain if cut is None else gain * _obstruction_gain(values, cut, like=gain)
        else:
            gain = _linear(gain_map.gain_db(values.file, values.sha256, uav_m, users_m))
        return gain if drawn is None else gain * _random_gain(values, uav_m, users_m, drawn, like=gain)
    ground_m = radio.ground_distance(uav_m, users_m)
    height_m = uav_m[..., 2:3]
    if isinstance(values, AirToGround):
        sight = air_to_ground_sight(values, height_m, ground_m, distance_m)
    else:
        sight = aerial_vehicle_sight(values, height_m, ground_m, distance_m)
    if cut is not None:
        sight = sight._replace(probability=sight.probability * ~cut)
    if drawn is None:
        return mean_gain(sight, values.line_of_sight)
    return _random_gain_over_sight(values, sight, uav_m, users_m, drawn)


def _obstruction_gain(values: FreeSpace, cut: Array, like: Array) -> Array:
    """Gain of the links in free space that a building cuts, linear; 1 for the others, `[..., U]`."""
    loss_db = values.obstruction_loss_db
    assert loss_db is not None, "checked by parse()"
    return array_namespace(like).where(
        cut, constant((10.0 ** (-loss_db / 10.0),), like), constant((1.0,), like)
    )


def mean_gain(sight: Sight, line_of_sight: LineOfSight) -> Array:
    """Mean channel power gain of a link that has line of sight with a probability, linear, `[..., U]`."""
    probability, los_db, nlos_db = sight
    if line_of_sight == "mean_loss_db":
        return _linear(-(nlos_db + probability * (los_db - nlos_db)))
    return probability * _linear(-los_db) + (1.0 - probability) * _linear(-nlos_db)


def shadowing_sigmas_db(values: Radio, height_m: Array) -> tuple[float | Array, float | Array]:
    """Standard deviations of the shadowing with and without line of sight, dB, at `height_m` `[..., 1]`.

    Without `sigma_db` those of TR 36.777, Table B-3, heights as in `aerial_vehicle_sight`.
    """
    assert values.shadowing is not None, "checked by the caller"
    sigma_db = values.shadowing.sigma_db
    if sigma_db is not None:
        return sigma_db, sigma_db
    assert isinstance(values, AerialVehicle), "checked by parse()"
    xp, aerial = array_namespace(height_m), AERIAL[values.environment]
    height_m = xp.clip(height_m, aerial.min_height_m, AERIAL_MAX_HEIGHT_M)
    los_db = aerial.sigma_los_db * xp.exp(-aerial.sigma_los_per_m * height_m)
    return xp.clip(los_db, aerial.sigma_los_min_db, None), aerial.sigma_nlos_db


def _random_gain(values: Radio, uav_m: Array, users_m: Array, drawn: Realization, like: Array) -> Array:
    """Gain of shadowing and fading over a path with one loss, linear, `[..., U]` as `like`."""
    gain = array_namespace(like).ones_like(like)
    if values.shadowing is not None:
        sigma_db, _ = shadowing_sigmas_db(values, uav_m[..., 2:3])
        gain = _linear(-sigma_db * stochastic.shadowing(drawn.waves, uav_m, users_m))
    if values.fading is not None:
        gain = gain * stochastic.fading(values.fading, drawn.link_seed, like=gain)
    return gain


def _random_gain_over_sight(
    values: AirToGround | AerialVehicle, sight: Sight, uav_m: Array, users_m: Array, drawn: Realization
) -> Array:
    """Channel power gain of a link with and without line of sight that draws, linear, `[..., U]`."""
    if values.shadowing is not None:
        los_db, nlos_db = shadowing_sigmas_db(values, uav_m[..., 2:3])
        relative = stochastic.shadowing(drawn.waves, uav_m, users_m)
        sight = Sight(sight.probability, sight.los_db + los_db * relative, sight.nlos_db + nlos_db * relative)
    line_of_sight = None
    if values.line_of_sight == "drawn":
        line_of_sight = stochastic.has_line_of_sight(sight.probability, drawn.link_seed)
        gain = _linear(-array_namespace(sight.los_db).where(line_of_sight, sight.los_db, sight.nlos_db))
    else:
        gain = mean_gain(sight, values.line_of_sight)
    if values.fading is not None:
        gain = gain * stochastic.fading(values.fading, drawn.link_seed, gain, line_of_sight)
    return gain


def air_to_ground_sight(values: AirToGround, height_m: Array, ground_m: Array, distance_m: Array) -> Sight:
    """Al-Hourani et al. 2014: P_LoS = 1 / (1 + a exp(-b (theta - a))), theta the elevation in degrees.

    Both losses are free space, 20 log10(4 pi f d / c), and the excess of the environment. `height_m` is
    `[..., 1]`; `ground_m` and `distance_m`, horizontal and 3D, are `[..., U]`.
    """
    a, b, excess_los_db, excess_nlos_db = ENVIRONMENTS[values.environment]
    xp = array_namespace(distance_m)
    elevation_deg = (180.0 / math.pi) * xp.atan2(height_m, ground_m)
    probability = 1.0 / (1.0 + a * xp.exp(-b * (elevation_deg - a)))
    wavelength_m = SPEED_OF_LIGHT_MPS / values.carrier_hz
    free_db = 20.0 * xp.log10(distance_m) + 20.0 * math.log10(4.0 * math.pi / wavelength_m)
    return Sight(probability, free_db + excess_los_db, free_db + excess_nlos_db)


def aerial_vehicle_sight(values: AerialVehicle, height_m: Array, ground_m: Array, distance_m: Array) -> Sight:
    """TR 36.777, tables B-1 and B-2; arguments as in `air_to_ground_sight`.

    h_UT is the UAV's altitude above the users, who take the place of the base station. A height outside the
    range of the tables counts as its limit: `scenario.parse` refuses such a grid, but a real vehicle may be
    some decimetres off its cell.
    """
    xp = array_namespace(distance_m)
    aerial = AERIAL[values.environment]
    height_m = xp.clip(height_m, aerial.min_height_m, AERIAL_MAX_HEIGHT_M)
    log_h, log_d = xp.log10(height_m), xp.log10(distance_m)
    p1_m = xp.clip(aerial.p1_slope * log_h + aerial.p1_offset, aerial.p1_min, None)
    d1_m = xp.clip(aerial.d1_slope * log_h + aerial.d1_offset, 18.0, None)
    near = d1_m / xp.maximum(ground_m, d1_m)  # 1 up to d1
    probability = near + xp.exp(-ground_m / p1_m) * (1.0 - near)
    probability = xp.where(height_m > aerial.certain_above_m, xp.ones_like(probability), probability)
    carrier_ghz = values.carrier_hz / 1e9
    carrier_db = 20.0 * math.log10(carrier_ghz)
    at_1m_db = 20.0 * math.log10(40.0 * math.pi * carrier_ghz / 3.0)  # free space at 1 m, c = 3e8 m/s
    if values.environment == "rma_av":
        los_db = xp.clip(23.9 - 1.8 * log_h, 20.0, None) * log_d + at_1m_db
        nlos_db = xp.maximum(los_db, -12.0 + (35.0 - 5.3 * log_h) * log_d + at_1m_db)
    elif values.environment == "uma_av":
        los_db = 28.0 + 22.0 * log_d + carrier_db
        nlos_db = -17.5 + (46.0 - 7.0 * log_h) * log_d + at_1m_db
    else:
        los_db = 30.9 + (22.25 - 0.5 * log_h) * log_d + carrier_db
        los_db = xp.maximum(20.0 * log_d + at_1m_db, los_db)
        nlos_db = xp.maximum(los_db, 32.4 + (43.2 - 7.6 * log_h) * log_d + carrier_db)
    return Sight(probability, los_db, nlos_db)


def _linear(gain_db: Array) -> Array:
    return array_namespace(gain_db).exp((math.log(10.0) / 10.0) * gain_db)


def inconsistencies(values: Radio, grid: Grid, users: UserSettings | None, mission_s: float) -> Iterator[str]:
    """Errors of an uplink for a grid and users, in missions of `mission_s`, seconds.

    Without `users`, which have errors of their own, those that do not depend on them.
    """
    has_sigma = values.shadowing is None or values.shadowing.sigma_db is not None
    if not has_sigma and not isinstance(values, AerialVehicle):
        yield "missing key radio.shadowing.sigma_db: only radio.model = 'tr_36_777' has values of its own"
    if isinstance(values, GainMap) and users is not None:
        area_m = users.area_m(grid, mission_s)
        yield from gain_map.inconsistencies(values.file, values.sha256, grid, area_m)
    if not isinstance(values, AerialVehicle):
        return
    aerial, top_m = AERIAL[values.environment], grid.altitude_min_m + (grid.n_z - 1) * grid.altitude_step_m
    if grid.altitude_min_m <= aerial.min_height_m or top_m > AERIAL_MAX_HEIGHT_M:
        yield (
            f"grid: altitudes {grid.altitude_min_m:g} to {top_m:g} m; expected above "
            f"{aerial.min_height_m:g} and up to {AERIAL_MAX_HEIGHT_M:g} m, the range of "
            f"radio.environment = {values.environment!r}"
        )
    corners_m = [
        (x * (grid.n_x - 1) * grid.cell_m, y * (grid.n_y - 1) * grid.cell_m) for x in (0, 1) for y in (0, 1)
    ]
    for disc in () if users is None else users.start_discs():
        distance_m = max(math.dist(disc.centre_m, corner_m) for corner_m in corners_m) + disc.radius_m
        if distance_m > aerial.max_ground_distance_m:
            yield (
                f"{disc.key} = {list(disc.centre_m)}: its disc reaches {distance_m:.0f} m from "
                f"a corner of the grid; expected at most {aerial.max_ground_distance_m:g} m, the range of "
                f"radio.environment = {values.environment!r}"
            )
