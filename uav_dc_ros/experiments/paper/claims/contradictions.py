"""Claims that contradict arithmetic or one another, noted before any run that weighs them in many worlds."""

from typing import NamedTuple


class Contradiction(NamedTuple):
    """Something against a claim that no run can settle."""

    against: str  # other claims, or arithmetic
    why: str


_OPTIMUM = (
    "Let D be the (discounted) data term and Z the trajectory term that an agent maximises with the weights "
    "b and 1 - b, D' and Z' those with c and 1 - c, c > b. Each is the best for its own weights: "
    "b D + (1 - b) Z >= b D' + (1 - b) Z' and c D' + (1 - c) Z' >= c D + (1 - c) Z. The sum is "
    "(c - b)((D' - D) - (Z' - Z)) >= 0, and with both of them D' >= D and Z' <= Z: more weight on the data "
    "never collects less, and never brings the UAV home sooner."
)
CONTRADICTIONS: dict[str, tuple[Contradiction, ...]] = {
    "C4": (
        Contradiction(
            "the text on C14",
            'Both forms have "similar" rewards there; here, as in C8 and C9, episode is better.',
        ),
    ),
    "C5": (
        Contradiction(
            "C6, C7",
            "Dueling is similar to DQL here and better there: all hold only with a lead below 5%.",
        ),
    ),
    "C6": (Contradiction("C5", "Both hold only with a lead of dueling below 5%."),),
    "C7": (
        Contradiction("C5", "Both hold only with a lead of dueling below 5%."),
        Contradiction(
            "the text on C8",
            "Exponential is better for all ratios there, and here only up to 1:1. For one and the same "
            "flight its R_plus is never below the binary one: the head start is zeta/(beta + zeta) of the "
            "reward share.",
        ),
    ),
    "C8": (Contradiction("the text on C14", 'Both forms have "similar" rewards there.'),),
    "C9": (Contradiction("the text on C14", 'Both forms have "similar" rewards there.'),),
    "C10": (
        Contradiction("arithmetic", f"The throughput falls as beta grows. {_OPTIMUM}"),
        Contradiction(
            "C11", "DQL has its peak at 1:1 here and at 1:2 there: both hold only if it is exponential's."
        ),
    ),
    "C11": (Contradiction("C10", "DQL has its peak at 1:2 here and, with binary, at 1:1 there."),),
    "C12": (
        Contradiction("arithmetic", "2:1 is above 4:1: as in C10, more weight on the data collects less."),
        Contradiction("C14", "1:1 stands out from 1:2 here; up to 1:1 all ratios are within 5% there."),
    ),
    "C13": (Contradiction("C14", "All ratios are within 5% here; from 1:1 on the throughput falls there."),),
    "C14": (
        Contradiction(
            "arithmetic",
            "From 1:1 on the throughput falls and the mission gets shorter as beta grows: both against C10's "
            "inequality. Under `at_time_limit` a mission flies all its steps, so flying home sooner does not "
            "raise its mean throughput either.",
        ),
        Contradiction(
            "C12, C13", "See there; the text on C17 calls the throughput stable over the ratios, too."
        ),
    ),
    "C17": (
        Contradiction(
            "C12, C14", "Its text calls the throughput stable over the ratios; they need it to differ."
        ),
    ),
    "C18": (
        Contradiction(
            "arithmetic",
            "The curves contain the exploration: of two equal policies the one with epsilon 0.95 takes half "
            "as many random actions as with 0.9, so its curve is higher.",
        ),
    ),
}


def mark(claim: str) -> str:
    """What contradicts a claim, for a table; empty if nothing does."""
    return ", ".join(one.against for one in CONTRADICTIONS.get(claim, ()))
