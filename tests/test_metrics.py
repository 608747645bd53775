"""Metrics against closed forms and slow oracles (scikit-image, FLIP's own defaults, an
AlexNet written out).
"""

import importlib
import math
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from hdr_nsff.core.errors import InputError
from hdr_nsff.maths import metrics


def pictures(height=40, width=50, seed=0):
    """A smooth picture and a noisy copy."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width] / 10
    truth = np.stack([0.5 + 0.4 * np.sin(x + c) * np.cos(y) for c in range(3)], -1)
    noisy = (truth + 0.08 * rng.standard_normal(truth.shape)).clip(0, 1)
    return torch.from_numpy(noisy), torch.from_numpy(truth)


def test_psnr_of_a_known_error():
    a = torch.zeros(4, 4, 3)
    assert metrics.psnr(a, a + 0.1) == pytest.approx(20.0)  # 10 log10(1 / 0.01)
    assert metrics.psnr(a, a + 1.0, peak=10.0) == pytest.approx(20.0)
    assert metrics.psnr(a, a) == pytest.approx(100.0)


def test_psnr_of_an_infinite_error_is_its_limit():
    a = torch.zeros(4, 4, 3)
    assert metrics.psnr(a + math.inf, a) == -math.inf


def test_psnr_on_a_mask_sees_only_the_mask():
    a, mask = torch.zeros(4, 4, 3), torch.zeros(4, 4, dtype=torch.bool)
    b = a.clone()
    b[0, 0], mask[0, 0] = 0.1, True
    assert metrics.psnr(a, b, mask) == pytest.approx(20.0)
    assert metrics.psnr(a, b) == pytest.approx(20 + 10 * math.log10(16))


def test_psnr_and_ssim_agree_with_scikit_image():
    measure = pytest.importorskip("skimage.metrics")
    a, b = pictures()
    assert metrics.psnr(a, b) == pytest.approx(
        measure.peak_signal_noise_ratio(b.numpy(), a.numpy(), data_range=1)
    )
    published = {
        "gaussian_weights": True,
        "sigma": 1.5,
        "use_sample_covariance": False,
        "data_range": 1,
        "channel_axis": 2,
    }
    assert metrics.ssim(a, b) == pytest.approx(
        measure.structural_similarity(a.numpy(), b.numpy(), **published), abs=1e-9
    )


def test_ssim_of_equal_pictures_is_one_and_a_mask_averages_the_map():
    a, b = pictures()
    assert metrics.ssim(b, b) == pytest.approx(1.0)
    mixed = b.clone()
    mixed[:, 30:] = a[:, 30:]
    left = torch.zeros(40, 50, dtype=torch.bool)
    left[:, :24] = True  # six columns away from what differs
    assert metrics.ssim(mixed, b, left) == pytest.approx(1.0)
    assert metrics.ssim(mixed, b, ~left) < 0.9


def test_alignment_ignores_pixels_that_no_exposure_records():
    rng = torch.Generator().manual_seed(0)
    truth = torch.rand(1000, 3, generator=rng) + 0.1
    radiance = truth / torch.tensor([2.0, 4.0, 8.0])
    truth[:100] *= 500.0  # a lamp, predicted far too dark
    recordable = torch.arange(1000) >= 100
    scales = metrics.align(radiance, truth, recordable, per_channel=True)
    torch.testing.assert_close(scales, torch.tensor([2.0, 4.0, 8.0]))
    assert metrics.align(radiance, truth, recordable).item() == pytest.approx(4.0)
    least_squares = float((radiance * truth).sum() / radiance.square().sum())
    assert least_squares > 20  # led astray by the lamp


def test_alignment_without_common_pixels_is_one():
    every = torch.ones(5, dtype=torch.bool)
    assert metrics.align(torch.zeros(5, 3), torch.ones(5, 3), every).item() == 1.0


def test_mu_law_psnr_worked_by_hand():
    truth = torch.full((2, 2, 3), 8.0)  # at the peak: 1 after the mu-law
    radiance = torch.full((2, 2, 3), 8.0 / 50)  # log(2) / log(51)
    expected = -20 * math.log10(1 - math.log(2) / math.log(51))
    psnr = metrics.mu_law_psnr(radiance, truth, peak=8.0, mu=50.0)
    assert psnr == pytest.approx(expected, rel=1e-6)


def test_mu_law_psnr_clips_at_the_peak():
    truth = torch.full((2, 2, 3), 8.0)
    assert metrics.mu_law_psnr(truth * 3, truth, peak=8.0) == pytest.approx(100.0)


def pu21_code(nits):
    """Mantiuk and Azimi 2021, banding + glare, as printed."""
    p = (
        0.353487901,
        0.3734658629,
        8.277049286e-05,
        0.9062562627,
        0.09150303166,
        0.9099517204,
        596.3148142,
    )
    return p[6] * (((p[0] + p[1] * nits ** p[3]) / (1 + p[2] * nits ** p[3])) ** p[4] - p[5])


def test_pu21_psnr_worked_by_hand():
    """White is 1000 cd/m^2, half of it 500; their codes are compared with a peak of
    256, the code of 100 cd/m^2.
    """
    truth = torch.full((2, 2, 3), 8.0)
    assert pu21_code(100) == pytest.approx(256, abs=0.5)
    assert 300 < pu21_code(500) < pu21_code(1000) < 500
    expected = 20 * math.log10(256 / (pu21_code(1000) - pu21_code(500)))
    assert metrics.pu21_psnr(truth / 2, truth, white=8.0) == pytest.approx(expected, abs=1e-6)


def test_pu21_psnr_clips_at_10000_nits():
    truth = torch.full((2, 2, 3), 80.0)
    assert metrics.pu21_psnr(truth * 2, truth, white=8.0) == pytest.approx(100)


def test_pu21_psnr_on_a_mask_sees_only_the_mask():
    truth, mask = torch.full((4, 4, 3), 1.0), torch.zeros(4, 4, dtype=torch.bool)
    radiance = truth.clone()
    radiance[1, 2], mask[1, 2] = 0.5, True
    whole = metrics.pu21_psnr(radiance, truth, 1.0)
    part = metrics.pu21_psnr(radiance, truth, 1.0, mask)
    assert whole - part == pytest.approx(10 * math.log10(16))


def test_pu21_white_ignores_a_lamp_of_few_pixels():
    truth = torch.full((100, 100, 3), 2.0)
    truth[:5, :8] = 700.0  # 0.4 % of the sequence
    assert metrics.pu21_white([truth]) == pytest.approx(2.0)
    truth[:10, :10] = 700.0  # 1 %
    assert metrics.pu21_white([truth]) == pytest.approx(700.0)
    other = torch.full((100, 200, 3), 2.0)
    assert metrics.pu21_white([truth, other]) == pytest.approx(2.0)  # one white for all views


def hdr():
    rng = np.random.default_rng(0)
    truth = torch.from_numpy(rng.gamma(0.5, 2.0, (48, 64, 3)))
    truth[:6, :6] = 60.0
    return truth * 1.1, truth


def test_the_flip_range_of_one_picture_is_flips_own():
    flip = pytest.importorskip("flip_evaluator")
    radiance, truth = hdr()
    _, mean, used = flip.evaluate(
        truth.float().numpy(), radiance.float().numpy(), "HDR", applyMagma=False
    )
    start, stop = metrics.flip_exposures([truth])
    assert (start, stop) == pytest.approx((used["startExposure"], used["stopExposure"]), abs=1e-3)
    errors = metrics.hdr_flip_map(radiance, truth, (start, stop))
    assert float(errors.mean()) == pytest.approx(mean, abs=2e-4)


def test_flip_of_equal_pictures_is_zero_and_differences_stay_local():
    pytest.importorskip("flip_evaluator")
    radiance, truth = hdr()
    mask = torch.zeros(48, 64, dtype=torch.bool)
    mask[20:30] = True
    exposures = (-5.0, 2.0)
    equal = metrics.hdr_flip_map(truth, truth, exposures)
    assert float(equal.max()) == pytest.approx(0.0, abs=1e-6)
    mixed = torch.where(mask[..., None], radiance, truth)
    errors = metrics.hdr_flip_map(mixed, truth, exposures)
    assert errors.shape == mask.shape and float(errors.max()) <= 1
    assert errors[mask].mean() > 2 * errors.mean()


def test_flip_is_none_where_it_is_not_installed(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "flip_evaluator", None)
    radiance, truth = hdr()
    assert metrics.hdr_flip_map(radiance, truth, (-5.0, 2.0)) is None


def ramp(height=6, width=9):
    """Radiance that rises by 1 per column and 10 per row, from 1."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return (1.0 + x + 10 * y)[..., None].repeat(1, 1, 3)


def everywhere(picture):
    return torch.ones(picture.shape[:2], dtype=torch.bool)


def test_hdr_tae_of_two_constants_worked_by_hand():
    one, rest = torch.ones(4, 5, 3), torch.zeros(4, 5, 2)
    every = everywhere(one)
    assert metrics.hdr_tae(one, 3 * one, rest, every) == (pytest.approx(2 / 4), 20)
    assert metrics.hdr_tae(one, one, rest, every) == (0, 20)
    assert metrics.hdr_tae(0 * one, 0 * one, rest, every) == (0, 20)  # black stays black
    assert metrics.hdr_tae(one, 0 * one, rest, every) == (pytest.approx(1), 20)  # the maximum
    colored = one * torch.tensor([1.0, 3.0, 9.0])
    error, _ = metrics.hdr_tae(one, colored, rest, every)
    assert error == pytest.approx((0 + 2 / 4 + 8 / 10) / 3)


def test_hdr_tae_follows_the_flow_and_leaves_out_pixels_that_leave_the_picture():
    """The pixel at column x + 1.5, row y + 1 is brighter by 1.5 + 10; the last two
    columns and the last row of 6 x 9 flow out.
    """
    here, there = ramp() + 11.5, ramp()
    flow = torch.tensor([1.5, 1.0]).expand(6, 9, 2)
    error, count = metrics.hdr_tae(here, there, flow, everywhere(here))
    assert error == pytest.approx(0, abs=1e-12) and count == 5 * 7
    wrong, _ = metrics.hdr_tae(here, there, torch.zeros(6, 9, 2), everywhere(here))
    assert wrong > 0.1


def test_hdr_tae_counts_the_mask_alone_and_no_scale_changes_it():
    one, rest = torch.ones(4, 5, 3), torch.zeros(4, 5, 2)
    other, mask = one.clone(), torch.zeros(4, 5, dtype=torch.bool)
    other[1, 1], mask[1, 1:3] = 3.0, True
    assert metrics.hdr_tae(one, other, rest, mask) == (pytest.approx(0.25), 2)
    scale = torch.tensor([0.1, 7.0, 1000.0])
    assert metrics.hdr_tae(one * scale, other * scale, rest, mask)[0] == pytest.approx(0.25)
    assert math.isnan(metrics.hdr_tae(one, other, rest, mask & False)[0])


def test_depth_errors_worked_by_hand():
    depth, truth = torch.tensor([[1.0, 3.0, 7.0]]), torch.tensor([[2.0, 4.0, 0.0]])
    abs_rel, rmse = metrics.depth_errors(depth, truth, truth > 0)
    assert abs_rel == pytest.approx((1 / 2 + 1 / 4) / 2) and rmse == pytest.approx(1.0)
    assert metrics.depth_errors(truth, truth, truth > 0) == (0, 0)


def test_the_median_ratio_ignores_unknown_values_and_outliers():
    truth = torch.tensor([2.0, 4.0, 6.0, 8.0, 900.0, 0.0, 5.0])
    values = torch.tensor([1.0, 2.0, 3.0, 4.0, 1.0, 5.0, 0.0])
    assert metrics.median_ratio(values, truth) == pytest.approx(2)
    assert metrics.median_ratio(torch.zeros(3), torch.ones(3)) == 1


@pytest.mark.parametrize("step, length", [((3.0, 4.0), 5.0), ((2.0, 3.0, 6.0), 7.0)])
def test_end_point_error_is_the_mean_distance(step, length):
    truth = torch.randn(4, 5, len(step), generator=torch.Generator().manual_seed(0))
    motion, known = truth.clone(), torch.zeros(4, 5, dtype=torch.bool)
    motion[2, 3] += torch.tensor(step)
    known[2, 1:4] = True
    assert metrics.end_point_error(motion, truth, known) == pytest.approx(length / 3, rel=1e-6)
    assert metrics.end_point_error(truth, truth, known) == 0


def alexnet_weights(seed=0):
    """Random weights under torchvision's and the LPIPS authors' names."""
    rng = torch.Generator().manual_seed(seed)
    shapes = {
        0: (64, 3, 11),
        3: (192, 64, 5),
        6: (384, 192, 3),
        8: (256, 384, 3),
        10: (256, 256, 3),
    }
    net, linear = {}, {}
    for k, (at, (o, i, s)) in enumerate(shapes.items()):
        net[f"features.{at}.weight"] = torch.randn(o, i, s, s, generator=rng) / math.sqrt(i * s * s)
        net[f"features.{at}.bias"] = torch.randn(o, generator=rng) * 0.1
        linear[f"lin{k}.model.1.weight"] = torch.rand(1, o, 1, 1, generator=rng)
    return net | {"classifier.1.weight": torch.zeros(2, 2)}, linear


def test_lpips_reads_one_file_or_two_and_equal_pictures_are_at_zero(tmp_path):
    net, linear = alexnet_weights()
    torch.save(net | linear, tmp_path / "both.pth")
    (tmp_path / "pair").mkdir()
    torch.save(net, tmp_path / "pair" / "alexnet.pth")
    torch.save(linear, tmp_path / "pair" / "lin.pth")
    one, two = metrics.Lpips(tmp_path / "both.pth"), metrics.Lpips(tmp_path / "pair")
    a, b = (p.float() for p in pictures(80, 96))
    assert one(a, b) == two(a, b) > 0
    assert one(a, a) == 0.0
    assert one(a, b) == pytest.approx(one(b, a))


def test_lpips_agrees_with_a_network_written_out(tmp_path):
    """torchvision's AlexNet, written as nn.Sequential, tapped after each ReLU."""
    net, linear = alexnet_weights()
    torch.save(net | linear, tmp_path / "w.pth")
    conv, relu, pool = torch.nn.Conv2d, torch.nn.ReLU, torch.nn.MaxPool2d
    layers = torch.nn.Sequential(
        *(conv(3, 64, 11, 4, 2), relu(), pool(3, 2)),
        *(conv(64, 192, 5, padding=2), relu(), pool(3, 2)),
        *(conv(192, 384, 3, padding=1), relu()),
        *(conv(384, 256, 3, padding=1), relu()),
        *(conv(256, 256, 3, padding=1), relu()),
    )
    features = {k.removeprefix("features."): v for k, v in net.items() if k.startswith("features")}
    layers.load_state_dict(features)
    a, b = (p.float() for p in pictures(80, 96))
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    activations = []
    for picture in (a, b):
        x = ((2 * picture - 1 - shift) / scale).permute(2, 0, 1)[None]
        taps = []
        for i, layer in enumerate(layers):
            x = layer(x)
            if i in (1, 4, 7, 9, 11):
                taps.append(x / x.square().sum(1, keepdim=True).sqrt())
        activations.append(taps)
    slow = 0.0
    for k, (x, y) in enumerate(zip(*activations, strict=True)):
        slow += ((x - y) ** 2 * linear[f"lin{k}.model.1.weight"]).sum(1).mean()
    assert metrics.Lpips(tmp_path / "w.pth")(a, b) == pytest.approx(slow.item(), rel=1e-5)


@pytest.fixture
def lpips_weights(monkeypatch):
    """benchmarks/lpips_weights.py as a module."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    return importlib.import_module("lpips_weights")


def test_weights_in_the_layout_of_flax_give_the_same_distance(lpips_weights, tmp_path, monkeypatch):
    net, linear = alexnet_weights()
    torch.save(net | linear, tmp_path / "theirs.pth")
    params = {"AlexNet_0": {}}
    for i, at in enumerate(metrics.Lpips.LAYERS):
        # out, in, h, w -> h, w, in, out
        kernel = net[f"features.{at}.weight"].permute(2, 3, 1, 0).numpy()
        importance = linear[f"lin{i}.model.1.weight"].permute(2, 3, 1, 0).numpy()
        bias = net[f"features.{at}.bias"].numpy()
        params["AlexNet_0"][f"Conv_{i}"] = {"kernel": kernel, "bias": bias}
        params[f"NetLinLayer_{i}"] = {"Conv_0": {"kernel": importance}}
    (tmp_path / "flax.ckpt").write_bytes(pickle.dumps(params))
    files = [str(tmp_path / "flax.ckpt"), str(tmp_path / "ours.pth")]
    monkeypatch.setattr("sys.argv", ["lpips_weights.py", *files])
    lpips_weights.main()
    a, b = (p.float() for p in pictures(80, 96))
    ours, theirs = metrics.Lpips(tmp_path / "ours.pth"), metrics.Lpips(tmp_path / "theirs.pth")
    assert ours(a, b) == theirs(a, b) > 0


def test_nothing_but_arrays_is_unpickled(lpips_weights, tmp_path):
    (tmp_path / "evil.ckpt").write_bytes(pickle.dumps({"AlexNet_0": Path("x")}))
    with pytest.raises(pickle.UnpicklingError, match="is no array"):
        lpips_weights.read_checkpoint(tmp_path / "evil.ckpt")


def test_lpips_on_a_mask_averages_maps_of_the_pictures_size(tmp_path):
    """Bilinear by hand: pixel center (i + 0.5) of n lies at (i + 0.5) m / n - 0.5 of m
    samples, ends repeated.
    """
    net, linear = alexnet_weights()
    torch.save(net | linear, tmp_path / "w.pth")
    model = metrics.Lpips(tmp_path / "w.pth")
    a, b = (p.float() for p in pictures(80, 96))
    mask = torch.zeros(80, 96, dtype=torch.bool)
    mask[10:50, 20:33] = True

    def weights(n, m):
        place = np.clip((np.arange(n) + 0.5) * m / n - 0.5, 0, m - 1)
        low = np.minimum(place.astype(int), max(m - 2, 0))
        matrix = np.zeros((n, m))
        matrix[np.arange(n), low] = 1 - (place - low)
        matrix[np.arange(n), np.minimum(low + 1, m - 1)] += place - low
        return matrix

    slow = sum(
        weights(80, d.shape[0]) @ d.numpy() @ weights(96, d.shape[1]).T
        for d in model.distances(a, b)
    )
    masked = model.on_mask(a, b, mask)
    assert masked == pytest.approx(slow[mask.numpy()].mean(), rel=1e-4)
    assert masked != pytest.approx(model(a, b), rel=1e-3)
    assert model.on_mask(a, a, mask) == 0


def test_lpips_names_what_is_wrong_with_its_weights(tmp_path):
    net, _ = alexnet_weights()
    torch.save(net, tmp_path / "half.pth")
    with pytest.raises(InputError, match=r"importance\.0 is missing"):
        metrics.Lpips(tmp_path / "half.pth")
    (tmp_path / "text.pth").write_text("no weights")
    with pytest.raises(InputError, match="not a readable torch state dict"):
        metrics.Lpips(tmp_path / "text.pth")
    with pytest.raises(InputError, match="no such weights file"):
        metrics.Lpips(tmp_path / "nowhere.pth")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"holds no \.pth file"):
        metrics.Lpips(tmp_path / "empty")


@pytest.mark.parametrize("channels", [(64, 128, 256, 512, 512), (64, 128, 256, 384, 384, 512, 512)])
def test_lpips_refuses_the_layers_of_vgg_and_squeezenet(tmp_path, channels):
    """Their files lie beside AlexNet's in the authors' package, with the same names."""
    net, linear = alexnet_weights()
    torch.save(net | linear, tmp_path / "alex.pth")
    others = {f"lin{k}.model.1.weight": torch.ones(1, c, 1, 1) for k, c in enumerate(channels)}
    torch.save(others, tmp_path / "other.pth")
    with pytest.raises(InputError, match=r"importance\.1 has the size of another network"):
        metrics.Lpips(tmp_path)
