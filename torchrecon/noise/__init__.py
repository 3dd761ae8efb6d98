"""How uncertain each observation is, and the noise covariance of a frame (eqs. 21-24)."""

from torchrecon.noise.blocks import inverse_blocks, mean_blocks
from torchrecon.noise.hessian import HessianParams, hessian_covariance
from torchrecon.noise.residual import ResidualParams, residual_covariance
from torchrecon.noise.structure_tensor import StructureTensorParams, image_noise, structure_tensor_covariance

__all__ = [
    "HessianParams",
    "ResidualParams",
    "StructureTensorParams",
    "hessian_covariance",
    "image_noise",
    "inverse_blocks",
    "mean_blocks",
    "residual_covariance",
    "structure_tensor_covariance",
]
