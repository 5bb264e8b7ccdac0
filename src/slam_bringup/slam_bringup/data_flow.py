# SPDX-License-Identifier: Apache-2.0
"""The data's way through the nodes as a Mermaid figure, made from the table of the nodes for ``docs/design.md``.

python -m slam_bringup.data_flow
"""

from __future__ import annotations

from slam_bringup.pipeline.node_table import NODES, NodeDeclaration


def figure() -> str:
    """A flow chart: nodes of the chain, an arrow for what one publishes and another takes, sensors at the left."""
    chain = [declared for declared in NODES if declared.outputs and not declared.is_tool]
    produced = {topic for declared in chain for topic in declared.outputs}
    lines = ["flowchart LR"]
    for declared in chain:
        sensors = sorted({_family(topic) for topic in declared.inputs if topic not in produced})
        lines += [f"    {family}([{family}]) --> {declared.executable}" for family in sensors]
    for source in chain:
        for target in chain:
            families = _shared(source, target)
            if families and source is not target:
                lines.append(f"    {source.executable} -- {', '.join(families)} --> {target.executable}")
    return "\n".join(lines) + "\n"


def _shared(source: NodeDeclaration, target: NodeDeclaration) -> list[str]:
    return sorted({_family(topic) for topic in source.outputs if topic in target.inputs})


def _family(topic: str) -> str:
    """The first part of a topic's name, which those of one kind share."""
    return topic.split("/", maxsplit=1)[0]


if __name__ == "__main__":
    print(figure(), end="")
