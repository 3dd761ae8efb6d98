"""Real motion on the synthetic body: joint positions -> bone directions -> the body's own constant lengths."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F

from torchrecon._typing import Float, Tensor
from torchrecon.data.synthetic.body import PART_NAMES, Body
from torchrecon.data.synthetic.motion import Motion
from torchrecon.data.synthetic.pose import swing
from torchrecon.data.synthetic.skeleton import JOINTS, forward_kinematics, joint, rotation_z
from torchrecon.errors import ReconError

__all__ = ["match_joints", "retarget_joints"]

# Names of the same place in the collections' 21-joint skeleton, in CMU's asf (a bone bears the name of the joint
# where it starts, so its end is one further) and in common BVH files. The first that is there is taken.
_SYNONYMS: dict[str, tuple[str, ...]] = {
    "pelvis": ("pelvis", "root", "hips", "hip"),
    "spine": ("spine", "lowerback"),
    "chest": ("chest", "upperback", "spine1"),
    "neck": ("thorax", "neck"),
    "head": ("upperneck", "head"),
    "shoulder": ("clavicle", "arm", "uparm", "shoulder"),
    "elbow": ("humerus", "elbow", "forearm", "lowarm"),
    "wrist": ("radius", "wrist", "hand"),
    "hand": ("hand", "hand_end", "fingerbase"),
    "hip": ("upleg", "thigh", "hipjoint", "hip"),
    "knee": ("femur", "knee", "leg", "lowleg", "shin"),
    "ankle": ("tibia", "ankle", "foot"),
    "toe": ("foot", "toe", "toebase", "toes", "foot_end"),
}
_OPTIONAL = ("spine", "chest", "head", "l_hand", "r_hand", "l_toe", "r_toe")


def match_joints(names: Sequence[str]) -> dict[str, int]:
    """Index in ``names`` of each of the body's joints that a skeleton has.

    Example:
        >>> match_joints(("root", "lfemur", "LeftFoot"))
        {'pelvis': 0, 'l_knee': 1, 'l_ankle': 2}
    """
    plain = [name.lower().replace(" ", "").split(":")[-1] for name in names]
    found: dict[str, int] = {}
    for name in JOINTS:
        if name[1] == "_":
            side = {"l": "left", "r": "right"}[name[0]]
            wanted = [w for s in _SYNONYMS[name[2:]] for w in (f"{name[0]}_{s}", f"{name[0]}{s}", f"{side}{s}")]
        else:
            wanted = list(_SYNONYMS[name])
        hit = next((w for w in wanted if w in plain and plain.index(w) not in found.values()), None)
        if hit is not None:
            found[name] = plain.index(hit)
    return found


def _sources(joints: Tensor, names: Sequence[str]) -> dict[str, Tensor]:
    """Position of all 21 joints; what a skeleton lacks is put where it makes no bend."""
    found = match_joints(names)
    if "neck" not in found and {"l_shoulder", "r_shoulder"} <= found.keys():
        middle = 0.5 * (joints[:, found["l_shoulder"]] + joints[:, found["r_shoulder"]])
    else:
        middle = joints[:, found["neck"]] if "neck" in found else joints[:, 0]
    lacking = [n for n in JOINTS if n not in found and n not in (*_OPTIONAL, "neck")]
    if lacking:
        raise ReconError(
            f"retarget_joints: no joint for {', '.join(lacking)} among {', '.join(names)}; rename the joints "
            "(for instance l_knee, LeftLeg or ltibia) or leave the clip out"
        )
    at = {name: joints[:, index] for name, index in found.items()}
    at["neck"] = middle
    at.setdefault("spine", at["pelvis"] + 0.3 * (at["neck"] - at["pelvis"]))
    at.setdefault("chest", at["spine"] + 0.5 * (at["neck"] - at["spine"]))
    at.setdefault("head", at["neck"] + 0.5 * (at["neck"] - at["chest"]))
    across = F.normalize(at["l_hip"] - at["r_hip"], dim=-1)
    for s in ("l", "r"):
        at.setdefault(f"{s}_hand", at[f"{s}_wrist"] + 0.3 * (at[f"{s}_wrist"] - at[f"{s}_elbow"]))
        shank = F.normalize(at[f"{s}_knee"] - at[f"{s}_ankle"], dim=-1)
        forward = torch.linalg.cross(across, shank)
        at.setdefault(f"{s}_toe", at[f"{s}_ankle"] + 0.1 * forward - 0.02 * shank)
    return at


def _aim(offset: Tensor, direction: Tensor, axis: Tensor, lateral: Tensor) -> Tensor:
    """Rotations that take ``offset`` onto ``direction``, and ``axis`` as nearly as possible onto ``lateral``."""

    def basis(first: Tensor, second: Tensor) -> Tensor:
        a = F.normalize(first, dim=-1)
        b = F.normalize(second - (second * a).sum(-1, keepdim=True) * a, dim=-1)
        return torch.stack([a, b, torch.linalg.cross(a, b)], -1)

    return basis(direction, lateral) @ basis(offset, axis).transpose(-1, -2)


def _bend(upper: Tensor, lower: Tensor) -> Tensor:
    """Normal of a limb's plane, as long as the sine of its bend; to the left for a knee, to the right for an elbow."""
    normal: Tensor = torch.linalg.cross(F.normalize(upper, dim=-1), F.normalize(lower, dim=-1))
    return normal


def _hinge(frame: Tensor, normal: Tensor, fps: float) -> Tensor:
    """Hinge axis (to the left) of knees or elbows.

    The plane of the bent limb gives it, ``normal`` being weighted by the sine of the bend. A straight limb has no
    plane and a noisy one bends backwards: the axis is averaged over time in ``frame``, which follows the upper bone
    by the smallest rotation, sharply (0.06 s) where the limb is bent and from as far away as needed (0.5 s) where it
    is not; the frame's own left decides when all is straight.
    """
    local = torch.einsum("fji,fj->fi", frame, normal)
    count = len(local)
    gap = (torch.arange(count)[:, None] - torch.arange(count)).to(local) / fps
    kernel = torch.exp(-0.5 * (gap / 0.06) ** 2) / 0.06 + 0.03 * torch.exp(-0.5 * (gap / 0.5) ** 2) / 0.5
    mean = kernel @ local / kernel.sum(-1, keepdim=True)
    mean = mean + 0.03 * torch.tensor([1.0, 0.0, 0.0], dtype=local.dtype)
    return F.normalize(torch.einsum("fij,fj->fi", frame, mean), dim=-1)


def retarget_joints(
    joints: Float[Tensor, "frames joints 3"],
    parents: Sequence[int],
    names: Sequence[str],
    body: Body,
    fps: float,
    action: str = "mocap",
) -> Motion:
    """Drive a body by captured joints, whatever the captured skeleton's proportions.

    Head, arms and legs take the captured directions and the body's own lengths. Trunk and feet, where skeletons differ
    in what their joints mean, take the captured movement on the body's own build: two halves of the trunk, clavicles
    by their departure from their mean, feet so that they stand level. What positions leave open, the twist, follows
    fixed rules: pelvis and shoulders from their own left-right lines, the spine between them, knees and elbows as
    hinges, hands and feet from the limb above. The path of the pelvis is scaled by the ratio of the leg lengths, and
    the clip is set on the floor by its lowest foot.

    Args:
        joints: metres, y up.
        parents: of the captured skeleton; only their number is checked, joints are found by name.
        names: of the captured joints.
        fps: frames per second.
        action: name to be noted.

    Raises:
        ReconError: a needed joint is not there, or positions are not finite.

    Example:
        >>> import torch
        >>> from torchrecon.data.synthetic import sample_body, sample_motion
        >>> g = torch.Generator().manual_seed(0)
        >>> source = sample_motion("run", sample_body(g), frames=10, generator=g)
        >>> motion = retarget_joints(source.joints, source.parents, source.names, sample_body(g), source.fps)
        >>> motion.joints.shape
        torch.Size([10, 21, 3])
    """
    if len(names) != joints.shape[1] or len(parents) != joints.shape[1]:
        raise ReconError(f"retarget_joints: {joints.shape[1]} joints, {len(names)} names, {len(parents)} parents")
    if not joints.isfinite().all():
        frame = int((~joints.isfinite()).any(-1).any(-1).nonzero()[0])
        raise ReconError(f"retarget_joints: frame {frame} has positions that are not finite; fill them or cut the clip")
    at = _sources(joints.double(), names)
    legs = sum(
        (at[f"{s}_{a}"] - at[f"{s}_{b}"]).norm(dim=-1) for s in "lr" for a, b in (("hip", "knee"), ("knee", "ankle"))
    )
    own = 2 * (body.bone("l_knee") + body.bone("l_ankle"))
    bones = _bone_frames(at, body, fps)
    root = at["pelvis"] * (own / float(torch.as_tensor(legs).median()))
    placed = forward_kinematics(root, bones, body.offsets)
    feet = [PART_NAMES.index("l_foot"), PART_NAMES.index("r_foot")]
    cones = body.place(placed, bones)
    soles = torch.stack(
        [
            cones.origins[:, feet, 1] - cones.radii[feet, 0] * cones.scale[feet, 1],
            placed[:, [joint("l_toe"), joint("r_toe")], 1] - body.toe_height,
        ]
    ).amin(0)
    placed = placed - torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64) * soles.amin()
    toes = placed[:, [joint("l_toe"), joint("r_toe")]]
    still = torch.zeros(toes.shape[:2], dtype=torch.bool)
    if len(toes) > 1:
        speed = (toes[1:] - toes[:-1]).norm(dim=-1) * fps
        still = torch.cat([speed[:1], speed]) < 0.35
    dtype = torch.get_default_dtype()
    return Motion(
        joints=placed.to(dtype),
        bones=bones.to(dtype),
        ball=torch.full((len(placed), 3), torch.nan, dtype=dtype),
        contacts=still & (toes[..., 1] < body.toe_height + 0.06),
        action=action,
        fps=float(fps),
    )


def _bone_frames(at: dict[str, Tensor], body: Body, fps: float) -> Float[Tensor, "frames 21 3 3"]:
    """Frames of all bones from captured positions."""
    left, up = torch.eye(3, dtype=torch.float64)[:2]
    hips = F.normalize(at["l_hip"] - at["r_hip"], dim=-1)
    shoulders = F.normalize(at["l_shoulder"] - at["r_shoulder"], dim=-1)
    # Trunk joints lie at other heights in every skeleton: only the lower and the upper half's directions are used.
    middle = _middle_of_trunk(at)
    lower, upper = F.normalize(middle - at["pelvis"], dim=-1), F.normalize(at["neck"] - middle, dim=-1)
    frames: dict[str, Tensor] = {"pelvis": _aim(up.expand_as(lower), lower, left.expand_as(lower), hips)}

    def aim(name: str, direction: Tensor, lateral: Tensor) -> None:
        offset = body.offsets[joint(name)].expand_as(direction)
        frames[name] = _aim(offset, direction, left.expand_as(direction), lateral)

    for name, share in (("spine", 0.0), ("chest", 0.5), ("neck", 1.0)):
        aim(name, lower + share * (upper - lower), hips + (0.2 + 0.7 * share) * (shoulders - hips))
    aim("head", at["head"] - at["neck"], shoulders)
    for s, sign in (("l", 1.0), ("r", -1.0)):
        pelvis, neck = frames["pelvis"], frames["neck"]
        frames[f"{s}_hip"] = pelvis
        frames[f"{s}_shoulder"] = _shrug(neck, at[f"{s}_shoulder"] - at["neck"])
        thigh, shank = at[f"{s}_knee"] - at[f"{s}_hip"], at[f"{s}_ankle"] - at[f"{s}_knee"]
        foot = at[f"{s}_toe"] - at[f"{s}_ankle"]
        # The foot points forward: it tells the axis of a leg too straight to have a plane.
        normal = _bend(thigh, shank) + 0.3 * _bend(foot, shank)
        hinge = _hinge(swing(pelvis, -pelvis[..., 1], thigh), normal, fps)
        arm, fore = at[f"{s}_elbow"] - at[f"{s}_shoulder"], at[f"{s}_wrist"] - at[f"{s}_elbow"]
        # From a raised arm (T pose) to any direction but across the body the smallest turn is unique.
        raised = neck @ rotation_z(torch.tensor(sign * torch.pi / 2, dtype=torch.float64))
        fold = _hinge(swing(raised, -raised[..., 1], arm), -_bend(arm, fore), fps)
        aim(f"{s}_knee", thigh, hinge)
        aim(f"{s}_ankle", shank, hinge)
        aim(f"{s}_elbow", arm, fold)
        aim(f"{s}_wrist", fore, fold)
        forearm = frames[f"{s}_wrist"]
        frames[f"{s}_hand"] = swing(forearm, -forearm[..., 1], _within(at[f"{s}_hand"] - at[f"{s}_wrist"], fore, 80.0))
        offset, lower_leg = body.offsets[joint(f"{s}_toe")], frames[f"{s}_ankle"]
        level = _level_foot(foot, lower_leg[..., 0], at[f"{s}_toe"][:, 1], offset)
        frames[f"{s}_toe"] = swing(lower_leg, lower_leg @ offset, level)
    return torch.stack([frames[name] for name in JOINTS], 1)


def _middle_of_trunk(at: dict[str, Tensor]) -> Tensor:
    """The point half-way along the captured pelvis - spine - chest - neck line."""
    line = torch.stack([at[name] for name in ("pelvis", "spine", "chest", "neck")], 1)
    length = (line[:, 1:] - line[:, :-1]).norm(dim=-1)
    end = length.cumsum(-1)
    half = 0.5 * end[:, -1:]
    share = ((half - (end - length)) / length.clamp_min(1e-9)).clamp(0, 1)
    middle: Tensor = line[:, 0] + (share[..., None] * (line[:, 1:] - line[:, :-1])).sum(1)
    return middle


def _shrug(frame: Tensor, clavicle: Tensor) -> Tensor:
    """The shoulder's bone frame: the trunk's, turned as far as the captured clavicle leaves its mean in the clip.

    Captured shoulders sit above, below or behind the point called neck, depending on the skeleton; their mean place
    is the body's own, only the movement is taken over.
    """
    local = F.normalize(torch.einsum("fji,fj->fi", frame, clavicle), dim=-1)
    mean = F.normalize(local.mean(0), dim=-1).expand_as(local)
    return frame @ swing(torch.eye(3, dtype=frame.dtype).expand_as(frame), mean, local)


def _within(direction: Tensor, axis: Tensor, degrees: float) -> Tensor:
    """Directions, brought back to a cone about ``axis``: no wrist bends farther, but short noisy hands seem to."""
    d, a = F.normalize(direction, dim=-1), F.normalize(axis, dim=-1)
    cosine = (d * a).sum(-1, keepdim=True)
    side = F.normalize(d - cosine * a, dim=-1)
    limit = math.radians(degrees)
    return torch.where(cosine < math.cos(limit), math.cos(limit) * a + math.sin(limit) * side, d)


def _level_foot(foot: Tensor, hinge: Tensor, height: Tensor, offset: Tensor) -> Tensor:
    """Foot directions, turned about the ankle's hinge by the one angle that makes the captured foot level in stance.

    The bone ankle -> toe falls by 10 to 45 degrees in a level foot, depending on the skeleton. Its fall in the clip's
    flattest standing frames (toe near its lowest, 20 % quantile of the fall) is taken for the body's own.
    """
    fall = torch.atan2(-foot[:, 1], torch.hypot(foot[:, 0], foot[:, 2]))
    standing = height <= height.quantile(0.1) + 0.03
    tip = float((torch.atan2(-offset[1], offset[2]) - fall[standing].quantile(0.2)).clamp(-1.0, 1.0))
    d = F.normalize(foot, dim=-1)
    along = (d * hinge).sum(-1, keepdim=True) * hinge
    turned: Tensor = along + (d - along) * math.cos(tip) + torch.linalg.cross(hinge, d) * math.sin(tip)
    return turned
