"""What people type, shown under ``--help``; the tests parse every line."""

from __future__ import annotations

__all__ = ["EXAMPLES"]

EXAMPLES: dict[str, tuple[tuple[str, str], ...]] = {
    "": (
        ("torchrecon reconstruct clip.mp4 -o out/", "a video of a moving person to 3D"),
        ("torchrecon solve tracks.npz -o shape.npz", "point tracks to 3D"),
        ("torchrecon rank tracks.npz --json", "how many shape bases stand above the noise"),
        ("torchrecon export out/reconstruction.npz -o walk.bvh", "for Blender"),
        ("torchrecon doctor", "what is installed, what is missing"),
    ),
    "solve": (
        ("torchrecon solve tracks.npz -o shape.npz", "number of bases and solver are chosen"),
        ("torchrecon solve tracks.npz -o shape.npz --camera camera.json", "a camera whose intrinsics are known"),
        ("torchrecon solve tracks.npz -o shape.npz --rank 3 --json", "three bases, the summary as JSON"),
    ),
    "rank": (
        ("torchrecon rank tracks.npz", "one line: K and its interval"),
        ("torchrecon rank tracks.npz --rule bootstrap --json", "another rule, all fields as JSON"),
    ),
    "track": (
        ("torchrecon track clip.mp4 -o tracks.npz", "the mover is found in the clip"),
        ("torchrecon track frames/ -o tracks.npz --masks masks/", "a folder of images, masks of the person"),
        ("torchrecon track clip.mp4 -o joints.npz --pose rtmlib", "17 joints, where rtmlib and its weights are"),
    ),
    "reconstruct": (
        ("torchrecon reconstruct clip.mp4 -o out/", "tracks, reconstruction and report in out/"),
        ("torchrecon reconstruct frames/ -o out/ --depth depth/ --camera camera.json", "measured depth: metres"),
        ("torchrecon reconstruct clip.mp4 -o out/ --rank 2 --force", "replaces an earlier run's results"),
    ),
    "batch": (
        ("torchrecon batch clips/ -o results/", "each clip to results/NAME/; run it again to go on"),
        ("torchrecon batch clips/ -o results/ --workers 4 --json", "four processes, the counts as JSON"),
    ),
    "report": (
        ("torchrecon report shape.npz -o report.html", "a page that shows it and how far to trust it"),
        ("torchrecon report shape.npz -o report.html --tracks tracks.npz --video clip.mp4", "with the film beside it"),
    ),
    "export": (
        ("torchrecon export out/reconstruction.npz -o walk.bvh", "joint angles for Blender"),
        ("torchrecon export out/reconstruction.npz -o walk.trc --height 1.75", "OpenSim, a person of 1.75 m"),
        ("torchrecon export shape.npz -o shape.glb --tracks tracks.npz", "animated glTF with names and bones"),
        ("torchrecon export out/reconstruction.npz -o check.mp4 --video clip.mp4", "drawn on the clip"),
        ("torchrecon export shape.npz -o frames/", "one .ply file a frame"),
    ),
    "doctor": (
        ("torchrecon doctor", "versions, devices, extras"),
        ("torchrecon doctor --json", "the same for a bug report"),
    ),
    "completion": (
        ("source <(torchrecon completion bash)", "in ~/.bashrc"),
        ("source <(torchrecon completion zsh)", "in ~/.zshrc, after compinit"),
        ("torchrecon completion fish | source", "in ~/.config/fish/config.fish"),
    ),
}
