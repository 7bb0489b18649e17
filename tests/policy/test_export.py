"""The block of docs/extend/export.md that exports a chunk with `torch.export` runs as it stands
there.
"""

import re

import pytest
import torch

from helpers import REPOSITORY
from mme_vla.testing.small import random_batch


@pytest.mark.nightly
@pytest.mark.timeout(900)
def test_an_exported_chunk_is_the_policys_at_other_inputs() -> None:
    page = (REPOSITORY / "docs" / "extend" / "export.md").read_text()
    (block,) = [
        code
        for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL)
        if "torch.export.export(" in code
    ]
    space: dict = {"__name__": "docs_export"}
    exec(compile(block, "docs/extend/export.md", "exec"), space)
    policy, batch = space["policy"], random_batch(space["policy"], batch=1, seed=1)
    other = (batch.images, batch.prompt, batch.prompt_mask, -space["noise"])
    graph, eager = space["program"].module()(*other), space["Chunk"](policy, space["batch"])(*other)
    assert (eager - space["chunk"]).abs().max() > 0.1  # the inputs are no constants
    torch.testing.assert_close(graph, eager, rtol=1e-5, atol=1e-5)
