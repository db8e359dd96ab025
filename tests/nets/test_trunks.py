"""Trunks against other implementations of the same networks, and generalized-mean pooling."""

from __future__ import annotations

import itertools
from copy import deepcopy

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional as F
from transformers import (
    MobileNetV2Config,
    MobileNetV2ForSemanticSegmentation,
    ResNetConfig,
    ResNetModel,
)

from megloc_kapture.nets.deeplabv3plus import DeepLabV3Plus
from megloc_kapture.nets.trunks import (
    Bottleneck,
    Depth,
    InvertedResidual,
    ResNet,
    Vgg16Features,
    generalized_mean,
    imagenet_normalised,
)

# configuration D of the paper's table 1; P: pooling. torchvision counts convolution, ReLU, pooling
CONFIGURATION: tuple[int | str, ...] = (
    *(64, 64, "P", 128, 128, "P"),
    *(256, 256, 256, "P", 512, 512, 512, "P", 512, 512, 512, "P"),
)
BLOCKS: dict[Depth, list[int]] = {50: [3, 4, 6, 3], 101: [3, 4, 23, 3]}
LOW_LEVEL_WIDTH = 48


@pytest.fixture(scope="module")
def trunk() -> Vgg16Features:
    torch.manual_seed(0)
    net = Vgg16Features()
    for name, value in net.state_dict().items():
        # activations stay near 1, biases count
        value.normal_(0, 0.3 if name.endswith("bias") else (2 / value[0].numel()) ** 0.5)
    return net.eval().requires_grad_(False)


@pytest.fixture(scope="module")
def image() -> torch.Tensor:
    return torch.randn(2, 3, 33, 34, generator=torch.Generator().manual_seed(1))  # odd sides


def restated(state: dict[str, torch.Tensor], image: torch.Tensor) -> list[torch.Tensor]:
    """All activations, float64; pooling as the maximum of a window's four."""
    activations: list[torch.Tensor] = []
    x = image.double()
    for word in CONFIGURATION:
        if word == "P":
            height, width = x.shape[-2] // 2, x.shape[-1] // 2
            even = x[..., : 2 * height, : 2 * width]
            x = even.reshape(*x.shape[:2], height, 2, width, 2).amax((3, 5))
            activations.append(x)
            continue
        number = len(activations)
        weight, bias = (state[f"{number}.{kind}"].double() for kind in ("weight", "bias"))
        assert len(weight) == word
        x = F.conv2d(F.pad(x, (1, 1, 1, 1)), weight) + bias[:, None, None]
        activations.append(x)
        x = x.clamp(min=0)
        activations.append(x)
    return activations


def test_keys_and_shapes_are_torchvisions() -> None:
    with torch.device("meta"):
        state = Vgg16Features().state_dict()
    channels, number = 3, 0
    expected: dict[str, tuple[int, ...]] = {}
    for word in CONFIGURATION:
        if isinstance(word, str):
            number += 1
            continue
        expected[f"{number}.weight"] = (word, channels, 3, 3)
        expected[f"{number}.bias"] = (word,)
        channels, number = word, number + 2
    assert {key: tuple(value.shape) for key, value in state.items()} == expected
    assert number == 31 and sum(v.numel() for v in state.values()) == 14_714_688


def test_every_activation_is_the_restated_one(trunk: Vgg16Features, image: torch.Tensor) -> None:
    before = image.clone()
    # float32 differs between processors by as much as the bound
    found = deepcopy(trunk).double().taps(image.double(), range(31))
    expected = restated(trunk.state_dict(), image)
    assert len(expected) == len(found) == 31
    for one, other in zip(found, expected, strict=True):
        assert one.shape == other.shape and other.std() > 0.05
        torch.testing.assert_close(one.double(), other, rtol=0, atol=1e-5 * float(other.std()))
    assert torch.equal(image, before)


@pytest.mark.parametrize("last", [0, 1, 2, 28, 29, 30])
def test_a_trunk_that_ends_earlier(trunk: Vgg16Features, image: torch.Tensor, last: int) -> None:
    with torch.device("meta"):
        cut = Vgg16Features(last=last)
    assert set(cut.state_dict()) == {
        key for key in trunk.state_dict() if int(key.split(".")[0]) <= last
    }
    cut.load_state_dict(trunk.state_dict(), strict=False, assign=True)
    before = image.clone()
    assert torch.equal(cut(image), trunk.taps(image, [last])[0])
    assert torch.equal(image, before)
    assert (cut(image) < 0).any() == (last in (0, 2, 28))


def test_taps_are_in_the_order_of_their_indices_and_stay(
    trunk: Vgg16Features, image: torch.Tensor
) -> None:
    # layers that a later ReLU could spoil, asked for out of order and twice
    indices = (28, 3, 2, 29, 3)
    found = trunk.taps(image, indices)
    expected = restated(trunk.state_dict(), image)
    for number, one in zip(indices, found, strict=True):
        torch.testing.assert_close(one.double(), expected[number], rtol=0, atol=1e-4)
    assert (found[0] < 0).any() and (found[2] < 0).any()


def test_gradients_are_those_of_the_restated_chain(trunk: Vgg16Features) -> None:
    generator = torch.Generator().manual_seed(2)
    image = torch.randn(1, 3, 20, 17, generator=generator, requires_grad=True)
    (gradient,) = torch.autograd.grad(trunk.taps(image, [8, 15])[1].sum(), image)
    expected = torch.autograd.grad(restated(trunk.state_dict(), image)[15].sum(), image)[0]
    assert np.abs(expected.numpy()).max() > 0.1
    torch.testing.assert_close(gradient, expected.float(), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("indices", [[31], [-1], [3, 99], []])
def test_layers_that_are_not_there(trunk: Vgg16Features, indices: list[int]) -> None:
    with pytest.raises(ValueError, match="are not of 0 to 30"):
        trunk.taps(torch.zeros(1, 3, 16, 16), indices)
    with pytest.raises(ValueError, match="last is 31"):
        Vgg16Features(last=31)


def randomised(module: nn.Module, seed: int = 0) -> nn.Module:
    """Weights whose activations stay near 1, statistics of no layer trivial."""
    torch.manual_seed(seed)
    for part in module.modules():
        if isinstance(part, nn.Conv2d):
            nn.init.kaiming_normal_(part.weight, mode="fan_in")
        if isinstance(part, nn.BatchNorm2d):
            nn.init.uniform_(part.weight, 0.3, 0.7)
            nn.init.uniform_(part.bias, -0.3, 0.3)
            part.running_mean.uniform_(-0.2, 0.2)
            part.running_var.uniform_(0.5, 2.0)
    return module.eval()


def resnet_names(key: str) -> str:
    """Key of our trunk -> key of transformers'."""
    parts = key.split(".")
    kind = {"c": "convolution", "b": "normalization"}
    if parts[0] in ("conv1", "bn1"):
        return f"embedder.embedder.{kind[parts[0][0]]}.{parts[-1]}"
    stage, block = int(parts[0][-1]) - 1, parts[1]
    place = f"encoder.stages.{stage}.layers.{block}"
    if parts[2] == "downsample":
        return (
            f"{place}.shortcut.{'convolution' if parts[3] == '0' else 'normalization'}.{parts[4]}"
        )
    return f"{place}.layer.{int(parts[2][-1]) - 1}.{kind[parts[2][0]]}.{parts[3]}"


@pytest.mark.parametrize(("depth", "size"), [(50, (97, 130)), (101, (64, 80))])
def test_the_stages_are_transformers_stages(depth: Depth, size: tuple[int, int]) -> None:
    ours = randomised(ResNet(depth))
    theirs = ResNetModel(ResNetConfig(depths=BLOCKS[depth], layer_type="bottleneck")).eval()
    renamed = {resnet_names(key): value for key, value in ours.state_dict().items()}
    theirs.load_state_dict(renamed, strict=True)
    image = torch.randn(2, 3, *size)
    with torch.inference_mode():
        found = ours(image)
        expected = theirs(image, output_hidden_states=True).hidden_states[1:]
    assert [f.shape[1] for f in found] == [256, 512, 1024, 2048]
    for one, other in zip(found, expected, strict=True):
        assert one.shape == other.shape
        assert other.std() > 0.1  # the comparison says something
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5 * float(other.abs().max()))


@pytest.mark.parametrize("output_stride", [8, 16])
def test_dilations_keep_what_strides_would_give(output_stride: int) -> None:
    # every place that the strided trunk has, the dilated one has too, with the same features
    strided = randomised(ResNet(50))
    dilated = ResNet(50, output_stride=output_stride).eval()
    dilated.load_state_dict(strided.state_dict(), strict=True)
    image = torch.randn(1, 3, 75, 118)
    with torch.inference_mode():
        few, many = strided(image), dilated(image)
    for one, other in zip(few, many, strict=True):
        step = -(-other.shape[-1] // one.shape[-1])
        sampled = other[:, :, ::step, ::step]
        torch.testing.assert_close(sampled, one, rtol=1e-5, atol=1e-5 * float(one.abs().max()))
    assert many[-1].shape[-2:] == (-(-75 // output_stride), -(-118 // output_stride))
    assert many[-1].shape[-1] > few[-1].shape[-1]


def test_a_dilated_convolution_reaches_two_pixels_far() -> None:
    block = randomised(Bottleneck(8, 2, stride=1, dilation=2))
    x = torch.randn(1, 2, 7, 6)
    with torch.inference_mode():
        found = block.conv2(x)[0].numpy()
    weight, padded = (
        block.conv2.weight.detach().numpy(),
        np.pad(x[0].numpy(), [(0, 0)] + 2 * [(2, 2)]),
    )
    by_hand = np.zeros((2, 7, 6))
    for out, row, column in itertools.product(range(2), range(7), range(6)):
        window = padded[:, row : row + 5 : 2, column : column + 5 : 2]
        by_hand[out, row, column] = (weight[out] * window).sum()
    np.testing.assert_allclose(found, by_hand, atol=1e-5)


def test_normalised_is_zero_at_the_mean_and_one_a_deviation_above() -> None:
    mean, deviation = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    for image, expected in ((mean, 0.0), (mean + deviation, 1.0)):
        tensor = torch.tensor(image, dtype=torch.float32)[None, :, None, None].expand(1, 3, 2, 4)
        torch.testing.assert_close(imagenet_normalised(tensor), torch.full((1, 3, 2, 4), expected))


def randomised_mobilenet(module: nn.Module) -> nn.Module:
    torch.manual_seed(0)
    for part in module.modules():
        if isinstance(part, nn.Conv2d):
            nn.init.kaiming_normal_(part.weight, mode="fan_in")
        if isinstance(part, nn.BatchNorm2d):
            nn.init.uniform_(part.weight, 0.5, 1.0)
            nn.init.uniform_(part.bias, -0.3, 0.3)
            part.running_mean.uniform_(-0.2, 0.2)
            part.running_var.uniform_(0.5, 2.0)
    return module.eval()


def mobilenet_names(key: str) -> str:
    """Key of our trunk -> key of transformers'."""
    _, layer, *rest = key.split(".")
    kinds = ("convolution", "normalization")
    if layer == "0":
        return f"conv_stem.first_conv.{kinds[int(rest[0])]}.{rest[1]}"
    place = "conv_stem" if layer == "1" else f"layer.{int(layer) - 2}"
    first = 1 if layer == "1" else 0  # the first block has no expansion
    part = int(rest[1])
    if len(rest) == 4:
        name = ("expand_1x1", "conv_3x3")[part + first]
        return f"{place}.{name}.{kinds[int(rest[2])]}.{rest[3]}"
    return f"{place}.reduce_1x1.{kinds[part - (2 - first)]}.{rest[2]}"


def without_what_transformers_lacks(network: nn.Module) -> None:
    """Make DeepLabV3+ over MobileNetV2 that of transformers, where the two differ."""
    for name, part in network.backbone.named_modules():
        # padding before or after an expansion is the same where it makes zeros of zeros
        if isinstance(part, nn.BatchNorm2d) and name.endswith("conv.0.1") and ".1.conv" not in name:
            nn.init.zeros_(part.bias)
            part.running_mean.zero_()
    head = network.classifier
    project, sharpen = head.aspp.project[0], head.classifier[0]
    with torch.no_grad():
        project.weight[:, 256:1024] = 0.0  # it has no dilated branches
        # and no decoder: the 3x3 convolution hands on what the pyramid says, which is not negative
        sharpen.weight.zero_()
        sharpen.weight[:, LOW_LEVEL_WIDTH:, 1, 1] = torch.eye(256)
    head.classifier[1] = nn.Identity()


def test_logits_are_transformers_logits() -> None:
    ours = randomised_mobilenet(DeepLabV3Plus("mobilenet", num_classes=19))
    without_what_transformers_lacks(ours)
    config = MobileNetV2Config(
        output_stride=16, tf_padding=False, layer_norm_eps=1e-5, num_labels=19
    )
    theirs = MobileNetV2ForSemanticSegmentation(config).eval()
    head = ours.classifier
    renamed = {
        f"mobilenet_v2.{mobilenet_names(key)}": value
        for key, value in ours.backbone.state_dict().items()
    }
    pyramid = head.aspp
    for name, layers in (
        ("conv_pool", list(pyramid.convs[4])[1:]),
        ("conv_aspp", pyramid.convs[0]),
        ("conv_projection", pyramid.project),
    ):
        for kind, layer in zip(("convolution", "normalization"), layers, strict=False):
            for key, value in layer.state_dict().items():
                renamed[f"segmentation_head.{name}.{kind}.{key}"] = value
    # its pooling branch is the first, ours the last
    one, pooled = pyramid.project[0].weight[:, :256], pyramid.project[0].weight[:, 1024:]
    renamed["segmentation_head.conv_projection.convolution.weight"] = torch.cat([pooled, one], 1)
    for key, value in head.classifier[3].state_dict().items():
        renamed[f"segmentation_head.classifier.convolution.{key}"] = value
    lacking = theirs.load_state_dict(renamed, strict=False)
    assert not lacking.unexpected_keys
    assert all(".conv_1x1." in key for key in lacking.missing_keys)  # the classifier's

    image = torch.rand(1, 3, 97, 130)
    with torch.inference_mode():
        # the frame that transformers' first convolution adds and ours does not
        framed = F.pad(imagenet_normalised(image), (1, 1, 1, 1))
        low_level, features = ours.backbone(framed)
        found = head(low_level, features)
        answer = theirs(imagenet_normalised(image), output_hidden_states=True)
    # bilinear scaling and a 1x1 convolution may change places
    logits = F.interpolate(
        answer.logits, size=low_level.shape[-2:], mode="bilinear", align_corners=False
    )
    hidden = answer.hidden_states
    for one, other in ((low_level, hidden[1]), (features, hidden[-1]), (found, logits)):
        assert one.shape == other.shape
        assert other.std() > 0.1
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5 * float(other.abs().max()))
    assert (low_level.shape[1], features.shape[1]) == (24, 320)


def test_a_block_pads_its_input_rather_than_its_expansion() -> None:
    block = randomised_mobilenet(InvertedResidual(3, 3, expansion=6, stride=1, dilation=2))
    x = torch.randn(1, 3, 6, 9)
    (expand, depthwise, project, normalise) = block.conv
    with torch.inference_mode():
        frame = expand(F.pad(x, (2, 2, 2, 2)))
        assert frame[:, :, 0].abs().max() > 0  # what the expansion makes of zeros
        by_hand = x + normalise(project(depthwise(frame)))
        torch.testing.assert_close(block(x), by_hand)
        inside = x + normalise(project(depthwise(F.pad(expand(x), (2, 2, 2, 2)))))
        assert (block(x) - inside).abs().max() > 1e-2
        torch.testing.assert_close(block(x)[:, :, 2:-2, 2:-2], inside[:, :, 2:-2, 2:-2])


def test_a_block_that_changes_size_or_channels_has_no_shortcut() -> None:
    x = torch.randn(1, 4, 7, 7)
    for out, stride in ((5, 1), (4, 2)):
        block = randomised_mobilenet(
            InvertedResidual(4, out, expansion=1, stride=stride, dilation=1)
        )
        with torch.inference_mode():
            torch.testing.assert_close(block(x), block.conv(F.pad(x, (1, 1, 1, 1))))


@pytest.mark.parametrize("power", [0.5, 1.0, 2.7, 3.0])
def test_definition(power: float) -> None:
    features = np.random.default_rng(0).uniform(0, 3, (2, 5, 4, 7))
    expected = np.zeros((2, 5))
    for image, channel in np.ndindex(2, 5):
        places = features[image, channel].ravel()
        expected[image, channel] = (sum(x**power for x in places) / len(places)) ** (1 / power)
    found = generalized_mean(torch.from_numpy(features), power)
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-12)


def test_mean_and_maximum_are_its_limits() -> None:
    features = torch.rand(3, 6, 5, 8, dtype=torch.float64, generator=torch.manual_seed(0))
    torch.testing.assert_close(generalized_mean(features, 1.0), features.mean(dim=(2, 3)))
    largest = features.amax(dim=(2, 3))
    for power in (3.0, 30.0, 300.0):
        found = generalized_mean(features, power)
        # of 40 places at least one has the largest value
        least = largest * 40 ** (-1 / power)
        assert (found <= largest).all() and (found >= least).all()
    torch.testing.assert_close(found, largest, rtol=0.02, atol=0)


def test_a_learnt_power_of_shape_one() -> None:
    features = torch.rand(2, 3, 4, 4)
    torch.testing.assert_close(
        generalized_mean(features, torch.tensor([2.5])), generalized_mean(features, 2.5)
    )


def test_nothing_below_the_minimum() -> None:
    features = torch.tensor([-5.0, 0.0, 1e-9]).view(1, 1, 1, 3)
    torch.testing.assert_close(generalized_mean(features, 3.0), torch.tensor([[1e-6]]))


def test_half_precision_does_not_overflow() -> None:
    features = torch.full((1, 1, 2, 2), 500.0, dtype=torch.float16)
    found = generalized_mean(features, 3.0)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, torch.tensor([[500.0]]))
