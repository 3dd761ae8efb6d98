"""torch.export and torch.compile take the recogniser, the covariance and equations (1) to (5) of SIFT, for any number
of frames, points and pixels.

In a process of its own: the shape checks of the test session are Python that the compiler cannot trace.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RECOGNISER = """
from torchrecon.models.recogniser import Recogniser

module = Recogniser(("run", "jump")).eval()
dims = {0: Dim("batch", min=1, max=64), 2: Dim("frames", min=8, max=512)}
inputs, others, shapes = (torch.rand(2, 2, 16, 24, 24),), (torch.rand(3, 2, 40, 24, 24),), (dims,)
"""
COVARIANCE = """
from torchrecon.noise.structure_tensor import structure_tensor_covariance

class Covariance(torch.nn.Module):
    def forward(self, image, xy):
        return structure_tensor_covariance(image, xy)

module, image, xy = Covariance(), torch.rand(1, 64, 80), 8 + 50 * torch.rand(12, 2)
inputs, others, shapes = (image, xy), (image, xy[:5]), ({}, {0: Dim("points", min=2, max=5000)})
"""
SIFT = """
from torchrecon.features.sift import difference_of_gaussians, gradient_polar, smooth

class Sift(torch.nn.Module):
    def forward(self, image):
        magnitude, angle = gradient_polar(smooth(image, 1.6))
        return difference_of_gaussians(image, 1.6), magnitude, angle.cos()  # a turn by 2 pi is none

module, size = Sift(), {0: Dim("height", min=32, max=2000), 1: Dim("width", min=32, max=2000)}
inputs, others, shapes = (torch.rand(48, 64),), (torch.rand(60, 50),), (size,)
"""
CHECK = """
exported = torch.export.export(module, inputs, dynamic_shapes=shapes)
torch.testing.assert_close(exported.module()(*others), module(*others))
torch.testing.assert_close(torch.compile(module, backend="aot_eager", fullgraph=True)(*inputs), module(*inputs))
"""


def test_exported_and_compiled_give_the_same():
    code = "import torch\nfrom torch.export import Dim\ntorch.manual_seed(0)\n"
    code += "".join(part + CHECK for part in (RECOGNISER, COVARIANCE, SIFT))
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
