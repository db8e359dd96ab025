"""Are the pairs of an MLAD file those of its relocalization file?"""

from __future__ import annotations

from collections.abc import Mapping

from megloc_kapture.evaluation.check.findings import Finding, plural, some
from megloc_kapture.evaluation.check.names import in_order


def match_pairs(
    named: Mapping[str, int], expected: Mapping[tuple[str, str], object]
) -> tuple[bool, list[Finding]]:
    """Compare the rows of an MLAD file with the pairs that are asked for.

    Parameters
    ----------
    named : keys (two timestamps with a blank between) -> line.
    expected : the pairs in the order of the relocalization file.

    Returns
    -------
    Whether the two timestamps are swapped, and what is wrong.
    """
    wanted = {" ".join(pair): None for pair in expected}
    unknown = [key for key in named if key not in wanted]
    turned = [key for key in unknown if " ".join(reversed(key.split(" "))) in wanted]
    if len(turned) > 0.5 * len(named):
        message = (
            f"the two timestamps are swapped in {plural(len(turned), 'row')}: the reference "
            "stands first, then the query"
        )
        return True, [Finding("error", "swapped", message, names=tuple(turned))]
    findings = [
        Finding("error", "unknown", f"pair {key} is not asked for", line=named[key], names=(key,))
        for key in unknown
    ]
    missing = [key for key in wanted if key not in named]
    if missing:
        findings.append(
            Finding(
                "error",
                "missing",
                f"{len(missing)} of {len(wanted)} pairs have no row, and every one is asked for: "
                f"{some(missing)}",
                names=tuple(missing),
            )
        )
    if not in_order(named, wanted):
        findings.append(
            Finding("note", "order", "the rows are not in the order of the relocalization file")
        )
    return False, findings
