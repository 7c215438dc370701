"""From evidence to verdict: what refutes the claims of a run, in sentences, and with which exit code it ends."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gapcert.certification.certificate import Certificate
    from gapcert.contracts.systems.system import StateSpec
    from gapcert.spec.sections.sections import CertificateConfig


def refutations(certificate: Certificate, asked: CertificateConfig | None) -> list[str]:
    """Each way in which a claim is refuted or was not reached, with a witness where there is one."""
    refuted = next((a for a in certificate.assumptions if a.startswith("REFUTED")), "")
    out = []
    if certificate.audit.refutes and (w := certificate.audit.witness(certificate.gap)) is not None:
        axes = certificate.domain.axes
        at = ", ".join(f"{a.name} = {v:.4g}{_unit(a)}" for a, v in zip(axes, w["z"], strict=True))
        state = axes[w["state"]]
        out.append(
            f"the audit refutes the gap function: {certificate.audit.violations} of {len(certificate.audit.z)} points; at {at} "
            f"the residual of {state.name} is {w['residual']:.6g}{_unit(state)}, {outside(w)}"
        )
    if certificate.gate is not None and (w := certificate.gate.attack.get("witness")) is not None:
        a = certificate.gate.attack
        out.append(
            f"γ of the default hidden state does not hold for others: {a['violations']} of {a['points']} probes exceed it; at "
            f"(x, u) = {w['z']} with hidden state {w['hidden']} the residual of {w['state']} is {w['residual']:.6g}, and γ is "
            f"{w['gamma']:.6g}"
        )
    if certificate.attack.get("violations", 0) > certificate.attack.get("allowed", 0):
        out.append(f"{certificate.attack['violations']} of {certificate.attack['points']} further fresh points leave [l, u]")
    if asked is not None and asked.claim != certificate.claim.kind and not out:
        out.append(f"a {asked.claim} claim was asked for: {refuted or 'its evidence does not allow it'}")
    elif refuted and not out:
        out.append(refuted)
    return out


def code_of(summary: Mapping[str, Any]) -> int:
    """The exit code of a finished run: by its expectations, or else by its verdict."""
    if expectations := summary.get("expectations"):
        return 0 if all(e["met"] for e in expectations) else 1
    return {"fails": 1, "unknown": 5}.get(summary["verdict"], 0)


def outside(witness: Mapping[str, Any]) -> str:
    """How a residual misses its band; ends that have crossed leave no value between them."""
    low, high = (f"{witness[k]:.6g}" for k in ("low", "high"))
    if witness["low"] <= witness["high"]:
        return f"outside [{low}, {high}]"
    return f"where no band is left: its lower end, {low}, lies above its upper one, {high}"


def _unit(axis: StateSpec) -> str:
    return "" if axis.unit in ("", "1") else f" {axis.unit}"


def nothing_won(evidence: Mapping[str, Any]) -> str:
    """What the evidence of a controller with nothing to promise says."""
    why = str(evidence.get("reason", ""))
    return f"no cell wins: {why}" if "winning_cells" in evidence else why or "the controller starts from no state"


def share(facts: Mapping[str, Any]) -> float | None:
    """The part of its grid, or of the set to stay in, from which a controller starts, as its facts say."""
    if "winning_cells" in facts and facts.get("cells"):
        return float(facts.get("winning_fraction", facts["winning_cells"] / facts["cells"]))
    return facts.get("domain_fraction")


def beside_nominal(careful: Mapping[str, Any], trusting: Mapping[str, Any]) -> dict[str, float]:
    """`domain_of_nominal`: the share with γ over that without; nothing where the latter starts from nowhere."""
    own, other = share(careful), share(trusting)
    return {"domain_of_nominal": own / other} if own is not None and other else {}
