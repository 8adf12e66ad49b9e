"""The parameters of CartPole and NoisyCartPole."""

from dataclasses import dataclass

GRAVITY = 9.8  # m/s^2
CART_MASS = 1.0  # kg
POLE_MASS = 0.1  # kg
TOTAL_MASS = CART_MASS + POLE_MASS
HALF_POLE = 0.5  # m
FORCE = 10.0  # N
TAU = 0.02  # s, one step
X_LIMIT = 2.4  # m
THETA_LIMIT = 12 * 2 * 3.141592653589793 / 360  # rad
START = 0.05  # all four variables start uniformly in [-START, START]


@dataclass(frozen=True)
class Params:
    """One difficulty."""

    max_steps: int  # time limit in steps; each survived step pays ``1 / max_steps``
    sigma: float = 0.0  # standard deviation of the noise on what is drawn (m, m/s, rad, rad/s)


LEVELS = {
    "CartPoleEasy": Params(200),
    "CartPoleMedium": Params(400),
    "CartPoleHard": Params(600),
    "NoisyCartPoleEasy": Params(200, 0.1),
    "NoisyCartPoleMedium": Params(200, 0.2),
    "NoisyCartPoleHard": Params(200, 0.3),
}
