"""The paper's claims, C1 to C20, and their findings."""

from collections.abc import Sequence
from typing import NamedTuple

from uav_dc_ros.experiments.paper import claims_learning, claims_reward, claims_throughput
from uav_dc_ros.experiments.paper.criteria import Assessment, Claim, Criterion, Verdict, joint
from uav_dc_ros.experiments.paper.evidence import Evidence, NotMeasured
from uav_dc_ros.experiments.paper.results import Results

CLAIMS = (*claims_reward.CLAIMS, *claims_throughput.CLAIMS, *claims_learning.CLAIMS)


class Finding(NamedTuple):
    """A claim and its outcome; the verdict is `not tested` if the results lack runs for it."""

    claim: Claim
    verdict: Verdict
    assessment: Assessment

    @property
    def decisive(self) -> Criterion | None:
        """The first criterion with the verdict of the claim."""
        return next((one for one in self.assessment.criteria if one.verdict == self.verdict), None)


def check(results: Results) -> list[Finding]:
    """Tests every claim against the results, in the order of `CLAIMS`."""
    evidence = Evidence(results)
    return [finding(claim, evidence) for claim in CLAIMS]


def count(findings: Sequence[Finding], verdict: Verdict) -> int:
    """Number of findings with a verdict."""
    return sum(one.verdict == verdict for one in findings)


def finding(claim: Claim, evidence: Evidence) -> Finding:
    """Tests one claim."""
    try:
        assessment = claim.assess(evidence)
    except NotMeasured:
        return Finding(claim, "not tested", Assessment(()))
    return Finding(claim, joint(assessment.criteria), assessment)
