"""Channel models: the path gain between the UAV and the users on the ground. `radio.model` names one.

`free_space`     the paper's eq. 2
`air_to_ground`  free space and an excess loss, with and without line of sight, whose probability grows with
                 the elevation. Al-Hourani, Kandeepan, Lardner, "Optimal LAP Altitude for Maximum Coverage",
                 IEEE Wireless Communications Letters 3(6), 2014
`tr_36_777`      3GPP TR 36.777 V15.0.0, "Enhanced LTE support for aerial vehicles", Annex B, tables B-1, B-2

docs/channels.md writes the formulas out, and states what this project assumes.
"""

import math
from typing import Annotated, Literal, NamedTuple, TypeAlias

import msgspec
from msgspec import Meta

from uav_dc_ros.core import radio
from uav_dc_ros.core.arrays import Array, array_namespace, constant
from uav_dc_ros.core.radio import Interference

# Mean over a link with and without line of sight. `mean_loss_db`: of the losses in dB, as in the letter.
# `mean_gain`: of the linear gains, which gives the mean received power.
LineOfSight: TypeAlias = Literal["mean_loss_db", "mean_gain"]
Positive: TypeAlias = Annotated[float, Meta(gt=0)]
CarrierHz: TypeAlias = Annotated[float, Meta(ge=1e8, le=1e11)]

SPEED_OF_LIGHT_MPS = 299_792_458.0


class RadioSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="model"):
    """The uplink: keys of every model."""

    bandwidth_hz: Positive  # bandwidth B, hertz
    tx_power_w: Positive  # transmit power p of a user, watts
    noise_power_dbm: Annotated[float, Meta(ge=-300, le=100)]  # noise power alpha^2, dBm

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


Radio: TypeAlias = FreeSpace | AirToGround | AerialVehicle


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
    """Range and line of sight of one environment of TR 36.777, Table B-1; h is the height, metres.

    p1 = max(p1_slope log10(h) + p1_offset, p1_min), d1 = max(d1_slope log10(h) + d1_offset, 18), metres.
    """

    min_height_m: float  # the UAV flies above it; below, the table refers to users on the ground
    max_ground_distance_m: float  # greatest horizontal distance (Table B-2)
    p1_slope: float
    p1_offset: float
    p1_min: float
    d1_slope: float
    d1_offset: float
    certain_above_m: float  # height above which line of sight is certain


AERIAL_MAX_HEIGHT_M = 300.0
AERIAL = {
    "rma_av": Aerial(10.0, 10_000.0, 15021.0, -16053.0, 1000.0, 1350.8, -1602.0, 40.0),
    "uma_av": Aerial(22.5, 4000.0, 4300.0, -3800.0, 0.0, 460.0, -700.0, 100.0),
    "umi_av": Aerial(22.5, 4000.0, 233.98, -0.95, 0.0, 294.05, -432.94, math.inf),
}


class Sight(NamedTuple):
    """A link with and without line of sight, each `[..., U]`."""

    probability: Array  # of line of sight
    los_db: Array  # path loss with line of sight
    nlos_db: Array  # path loss without


def title(values: Radio) -> str:
    """The channel in words: `free_space`, or `air_to_ground, urban, 2 GHz`."""
    model = str(values.__struct_config__.tag)
    if isinstance(values, FreeSpace):
        return model
    return f"{model}, {values.environment}, {values.carrier_hz / 1e9:g} GHz"


def path_gain(
    values: Radio, uav_m: Array, users_m: Array, distance_m: Array, cut: Array | None = None
) -> Array:
    """Channel power gain, linear, `[..., U]`.

    The UAV is at `uav_m` `[..., 3]`, the users on the ground at `users_m` `[..., U, 2]`, and `distance_m`
    `[..., U]` is their 3D distance, metres. A link that a building cuts (`cut`, bool `[..., U]`) loses
    `obstruction_loss_db` more in free space, and has no line of sight in the other models.
    """
    if isinstance(values, FreeSpace):
        gain = radio.path_gain(distance_m, values.ref_gain, values.path_loss_exponent)
        return gain if cut is None else gain * obstruction_gain(values, cut, like=gain)
    ground_m = radio.ground_distance(uav_m, users_m)
    height_m = uav_m[..., 2:3]
    if isinstance(values, AirToGround):
        sight = air_to_ground_sight(values, height_m, ground_m, distance_m)
    else:
        sight = aerial_vehicle_sight(values, height_m, ground_m, distance_m)
    if cut is not None:
        sight = sight._replace(probability=sight.probability * ~cut)
    return mean_gain(sight, values.line_of_sight)


def obstruction_gain(values: FreeSpace, cut: Array, like: Array) -> Array:
    """Gain of the links in free space that a building cuts, linear; 1 for the others, `[..., U]`."""
    loss_db = values.obstruction_loss_db
    assert loss_db is not None, "checked by parse()"
    return array_namespace(like).where(
        cut, constant((10.0 ** (-loss_db / 10.0),), like), constant((1.0,), like)
    )


def mean_gain(sight: Sight, line_of_sight: LineOfSight) -> Array:
    """Channel power gain of a link that has line of sight with a probability, linear, `[..., U]`."""
    probability, los_db, nlos_db = sight
    if line_of_sight == "mean_loss_db":
        return _linear(-(nlos_db + probability * (los_db - nlos_db)))
    return probability * _linear(-los_db) + (1.0 - probability) * _linear(-nlos_db)


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
