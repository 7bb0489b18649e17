"""The model without configuration, data and simulation: the examples of README.md and
docs/start/python.md.
"""

import ast
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

from helpers import REPOSITORY
from helpers.tiers import slow_or_nightly
from mme_vla.backbone.base import BackboneConfig, ExpertConfig, VisionConfig
from mme_vla.backbone.pi05 import Pi05Backbone
from mme_vla.integration.base import Integration
from mme_vla.model import MMEModel
from mme_vla.types import Batch

SIZES = BackboneConfig(
    VisionConfig(image_size=32, patch_size=8, width=32, depth=1, mlp_dim=32, num_heads=2),
    ExpertConfig(32, 32),
    ExpertConfig(16, 16),
    depth=1,
    head_dim=8,
    vocab_size=32,
)
THIRD_PARTY = {"torch", "numpy", "einops", "timm"}
MAX_MODULES = 25
REPORT = """
import sys
print(*(name for name in sys.modules if name.split(".")[0] == "mme_vla"))
print(float(loss))
"""


def example(page: str) -> str:
    blocks = (
        part.split("```")[0] for part in (REPOSITORY / page).read_text().split("```python\n")[1:]
    )
    (code,) = (code for code in blocks if "MMEModel(" in code)
    return code


def third_party(module: str) -> set[str]:
    """Packages outside the standard library that a module names at its top level."""
    spec = find_spec(module)
    assert spec is not None and spec.origin is not None
    roots = set()
    for node in ast.parse(Path(spec.origin).read_text()).body:
        if isinstance(node, ast.Import):
            roots |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            roots.add(node.module.split(".")[0])
    return roots - set(sys.stdlib_module_names) - {"mme_vla"}


@pytest.mark.parametrize(
    "page", slow_or_nightly(["README.md", "docs/start/python.md"], lambda page: page == "README.md")
)
def test_example_trains_and_imports_little(page: str) -> None:
    code = example(page) + REPORT
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=REPOSITORY
    )
    assert result.returncode == 0, result.stderr
    modules, loss = result.stdout.splitlines()
    assert float(loss) > 0
    names = modules.split()
    assert len(names) <= MAX_MODULES, names
    assert set().union(*map(third_party, names)) <= THIRD_PARTY


def test_readme_example_is_short() -> None:
    assert len([line for line in example("README.md").splitlines() if line.strip()]) <= 17


def two_samples(**changed: torch.Tensor | None) -> Batch:
    words = torch.ones(2, 4, dtype=torch.long)
    images = torch.zeros(2, 1, 3, 32, 32, dtype=torch.uint8)
    batch = Batch(
        images, torch.ones(2, 1).bool(), words, words.bool(), actions=torch.zeros(2, 20, 32)
    )
    return replace(batch, **changed)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"images": torch.zeros(2, 1, 3, 32, 32)}, "uint8 0…255, got torch.float32"),
        ({"images": torch.zeros(2, 1, 3, 48, 48).byte()}, r"resize them to \[3, 32, 32\]"),
        ({"images": torch.zeros(2, 1, 32, 32, 3).byte()}, r"Images are \[32, 32, 3\]"),
        ({"actions": None}, "Batch.actions is None"),
        ({"actions": torch.zeros(2, 20, 8)}, r"noise \[2, 20, 32\] differ in shape"),
        ({"actions": torch.zeros(2, 10, 32)}, r"noise \[2, 20, 32\] differ in shape"),
    ],
)
def test_batch_that_does_not_fit_is_named(
    changed: dict[str, torch.Tensor | None], message: str
) -> None:
    model = MMEModel(Pi05Backbone(SIZES), None, Integration(SIZES))
    noise = model.training_noise(2, torch.Generator().manual_seed(0))
    assert model(two_samples(), noise) > 0
    with pytest.raises(ValueError, match=message):
        model(two_samples(**changed), noise)


def test_precision_without_a_gradient_scaler_is_refused() -> None:
    with pytest.raises(ValueError, match="choose float32 or bfloat16"):
        MMEModel(Pi05Backbone(SIZES), None, Integration(SIZES), torch.float16)
