"""The paper's claims, C1 to C20, and their findings."""

from typing import NamedTuple

from uav_dc_ros.experiments.paper.claims import learning, reward, throughput
from uav_dc_ros.experiments.paper.claims.criteria import Claim, Criterion, Verdict, joint
from uav_dc_ros.experiments.paper.evidence import Evidence, NotMeasured
from uav_dc_ros.experiments.paper.results import Results
from uav_dc_ros.experiments.paper.setting import PAPER_ENVIRONMENTS

CLAIMS = (*reward.CLAIMS, *throughput.CLAIMS, *learning.CLAIMS)


class Finding(NamedTuple):
    """A claim and its outcome; the verdict is `not tested` if the results lack runs for it."""

    claim: Claim
    verdict: Verdict
    criteria: tuple[Criterion, ...]
    # In the first five environments alone, as many as the paper has; None without further ones.
    of_five: "Finding | None" = None

    @property
    def decisive(self) -> Criterion | None:
        """The first criterion with the verdict of the claim."""
        return next((one for one in self.criteria if one.decides and one.verdict == self.verdict), None)


def check(results: Results) -> list[Finding]:
    """Tests every claim against the results, in the order of `CLAIMS`."""
    evidence = Evidence(results)
    findings = [finding(claim, evidence) for claim in CLAIMS]
    if len(evidence.scale.environments) <= PAPER_ENVIRONMENTS:
        return findings
    five = Evidence(results.in_first(PAPER_ENVIRONMENTS))
    return [one._replace(of_five=finding(one.claim, five)) for one in findings]


def finding(claim: Claim, evidence: Evidence) -> Finding:
    """Tests one claim."""
    try:
        criteria = tuple(claim.test(evidence))
    except NotMeasured:
        return Finding(claim, "not tested", ())
    return Finding(claim, joint(criteria), criteria)
