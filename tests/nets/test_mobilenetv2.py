"""MobileNetV2 under DeepLabV3+ against transformers', same weights, and where the trunk differs."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional as F
from transformers import MobileNetV2Config, MobileNetV2ForSemanticSegmentation

from megloc_kapture.nets.deeplabv3plus import DeepLabV3Plus
from megloc_kapture.nets.mobilenetv2 import InvertedResidual
from megloc_kapture.nets.resnet import imagenet_normalised

LOW_LEVEL_WIDTH = 48


def randomised(module: nn.Module) -> nn.Module:
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


def as_transformers_names(key: str) -> str:
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
    ours = randomised(DeepLabV3Plus("mobilenet", num_classes=19))
    without_what_transformers_lacks(ours)
    config = MobileNetV2Config(
        output_stride=16, tf_padding=False, layer_norm_eps=1e-5, num_labels=19
    )
    theirs = MobileNetV2ForSemanticSegmentation(config).eval()
    head = ours.classifier
    renamed = {
        f"mobilenet_v2.{as_transformers_names(key)}": value
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
    block = randomised(InvertedResidual(3, 3, expansion=6, stride=1, dilation=2))
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
        block = randomised(InvertedResidual(4, out, expansion=1, stride=stride, dilation=1))
        with torch.inference_mode():
            torch.testing.assert_close(block(x), block.conv(F.pad(x, (1, 1, 1, 1))))
