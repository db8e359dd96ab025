"""Writes the files of this folder: ASLFeat built of TensorFlow's own operations, and its outputs.

In a separate environment (TensorFlow is not a dependency of the project):
``pip install tensorflow-cpu==2.21.0 && python make_reference.py``.

The graph is the layer table of the published one (github.com/lzx551402/ASLFeat, configuration
``aachen_eval.yaml``), in TensorFlow's layouts and under its variables' names; the weights are
random. ``variables.npz`` has them as ``tf.compat.v1.train.Saver`` saved them in the published
container and TensorFlow read them again. ``reference.npz`` has, for each of two images, the image
(uint8), the score
map, the raw outputs of conv6, and keypoints (x, y), scores and descriptors.
"""

import tempfile
from pathlib import Path

import numpy as np
import tensorflow as tf

tf1 = tf.compat.v1

HERE = Path(__file__).parent
CHECKPOINT = "model.ckpt-380000"
IMAGES = {"even": (48, 64), "odd": (45, 58)}  # height, width; 45 and 58 / 2 are odd
NUMBER = tf.float64  # of the calculation; the variables are float32, as published
EPSILON = 1e-5
# share of a kernel's values that are not zero, and these have one size: then the checkpoint,
# whose shapes are given, compresses well
DENSITY = 0.125


class Weights:
    """Variables of the graph with random values."""

    def __init__(self, seed):
        self._random = np.random.default_rng(seed)

    def variable(self, name, values):
        return tf1.get_variable(
            name, initializer=np.asarray(values, np.float32), use_resource=False
        )

    def kernel(self, scope, inputs, outputs, *, spread, bias=None):
        """A kernel whose outputs have this spread where its inputs are rectified normal numbers."""
        shape = (3, 3, inputs, outputs)
        # the image is a normal number, and not rectified
        density, mean_square = (1.0, 1.0) if inputs == 1 else (DENSITY, 0.5)
        filled = self._random.random(shape) < density
        size = spread / np.sqrt(9 * inputs * mean_square * density)
        signs = self._random.choice([-1.0, 1.0], shape)
        kernel = tf.cast(self.variable(f"{scope}/kernel", filled * signs * size), NUMBER)
        if bias is None:
            return kernel
        values = self._random.normal(0, bias, outputs)
        return kernel, tf.cast(self.variable(f"{scope}/bias", values), NUMBER)

    def moments(self, scope, channels):
        mean = self._random.normal(0, 0.1, channels)
        variance = self._random.uniform(0.5, 1.5, channels)
        return (
            tf.cast(self.variable(f"{scope}/bn/moving_mean", mean), NUMBER),
            tf.cast(self.variable(f"{scope}/bn/moving_variance", variance), NUMBER),
        )


def normalised(weights, scope, x):
    """Batch normalisation without scale and offset, then ReLU."""
    mean, variance = weights.moments(scope, x.shape[-1])
    return tf.nn.relu(tf.nn.batch_normalization(x, mean, variance, None, None, EPSILON))


def conv(weights, scope, x, outputs, stride=1):
    kernel = weights.kernel(scope, x.shape[-1], outputs, spread=1.0)
    return tf.nn.conv2d(x, kernel, stride, "SAME")


def deformable_conv(weights, scope, x, outputs):
    """Modulated deformable convolution: the padded map is read where the offsets say."""
    channels = x.shape[-1]
    padded = tf.pad(x, [[0, 0], [1, 1], [1, 1], [0, 0]])
    kernel, bias = weights.kernel(
        f"deform_param/{scope}/offset", channels, 18, spread=1.5, bias=0.3
    )
    offset = tf.nn.bias_add(tf.nn.conv2d(padded, kernel, 1, "VALID"), bias)
    kernel, bias = weights.kernel(
        f"deform_param/{scope}/amplitude", channels, 9, spread=1.0, bias=0.5
    )
    amplitude = tf.sigmoid(tf.nn.bias_add(tf.nn.conv2d(padded, kernel, 1, "VALID"), bias))

    height, width = tf.unstack(tf.shape(offset)[1:3])
    offset = tf.reshape(offset, [1, height, width, 9, 2])  # of each tap (dy, dx), row by row
    tap_y, tap_x = np.divmod(np.arange(9), 3)
    rows = tf.cast(tf.range(height)[:, None, None] + tap_y, NUMBER)
    columns = tf.cast(tf.range(width)[None, :, None] + tap_x, NUMBER)
    y = tf.clip_by_value(rows + offset[..., 0], 0, tf.cast(height, NUMBER) + 1)
    x = tf.clip_by_value(columns + offset[..., 1], 0, tf.cast(width, NUMBER) + 1)
    read = bilinear(padded, y, x) * amplitude[..., None]
    kernel = weights.kernel(scope, channels, outputs, spread=2.0)  # amplitudes are about a half
    return tf.einsum("bhwkc,kco->bhwo", read, tf.reshape(kernel, [9, channels, outputs]))


def bilinear(values, y, x):
    """Readings of a map (1, H, W, C) at (1, ...) rows and columns that lie in it."""
    last = tf.shape(values)[1:3] - 1
    y0, x0 = tf.cast(tf.floor(y), tf.int32), tf.cast(tf.floor(x), tf.int32)
    v, u = (y - tf.cast(y0, NUMBER))[..., None], (x - tf.cast(x0, NUMBER))[..., None]
    y1, x1 = tf.minimum(y0 + 1, last[0]), tf.minimum(x0 + 1, last[1])

    def at(rows, columns):
        return tf.gather_nd(values[0], tf.stack([rows, columns], axis=-1))

    upper = at(y0, x0) * (1 - u) + at(y0, x1) * u
    lower = at(y1, x0) * (1 - u) + at(y1, x1) * u
    return upper * (1 - v) + lower * v


def peakiness(weights, scope, x, dilation, size, scale):
    """Score map of the image's size, of one layer's raw outputs."""
    y = x / tf.cast(weights.variable(f"tower/{scope}/instance_max", scale), NUMBER)
    margin = [dilation, dilation]
    around = tf.nn.pool(
        tf.pad(y, [[0, 0], margin, margin, [0, 0]], "REFLECT"),
        [3, 3],
        "AVG",
        padding="VALID",
        dilations=margin,
    )
    alpha = tf.math.softplus(y - around)
    beta = tf.math.softplus(y - tf.reduce_mean(y, axis=-1, keepdims=True))
    score = tf.reduce_max(alpha * beta, axis=-1, keepdims=True)
    # what `tf.image.resize` was in TensorFlow 1
    resized = tf1.image.resize_bilinear(score, size, align_corners=False, half_pixel_centers=False)
    return tf.cast(resized, NUMBER)


def differences(score, filter_3x3, dilation):
    kernel = tf.constant(filter_3x3, NUMBER)[:, :, None, None]
    return tf.nn.depthwise_conv2d(
        score, kernel, [1, 1, 1, 1], "SAME", dilations=[dilation, dilation]
    )


def second_differences(score, dilation):
    ii = differences(score, [[0, 1, 0], [0, -2, 0], [0, 1, 0]], dilation)
    jj = differences(score, [[0, 0, 0], [1, -2, 1], [0, 0, 0]], dilation)
    ij = 0.25 * differences(score, [[1, 0, -1], [0, 0, 0], [-1, 0, 1]], dilation)
    return ii, jj, ij


def keypoints(score, features):
    """Keypoints (x, y) by falling score, scores, descriptors; above 0.5, 5 px inside, no edges."""
    ii, jj, ij = second_differences(score, 3)
    determinant, trace = ii * jj - ij * ij, ii + jj
    size = tf.shape(score)[1:3]
    inside = tf.pad(tf.ones(size - 10, tf.bool), [[5, 5], [5, 5]])[None, ..., None]
    chosen = (
        (score > 0.5)
        & tf.equal(score, tf.nn.max_pool2d(score, 3, 1, "SAME"))
        & inside
        & (determinant > 0)
        & (trace * trace / determinant <= 11**2 / 10)
    )
    pixels = tf.where(chosen[0, :, :, 0])
    values = tf.gather_nd(score[0, :, :, 0], pixels)
    order = tf.argsort(values, direction="DESCENDING", stable=True)
    pixels, values = tf.gather(pixels, order), tf.gather(values, order)

    ii, jj, ij = second_differences(score, 1)
    i = differences(score, [[0, -0.5, 0], [0, 0, 0], [0, 0.5, 0]], 1)
    j = differences(score, [[0, 0, 0], [-0.5, 0, 0.5], [0, 0, 0]], 1)
    determinant = ii * jj - ij * ij
    step = -tf.concat(
        [
            tf.math.divide_no_nan(jj * i - ij * j, determinant),
            tf.math.divide_no_nan(ii * j - ij * i, determinant),
        ],
        axis=-1,
    )
    step = tf.clip_by_value(tf.gather_nd(step[0], pixels), -0.5, 0.5)
    found = tf.cast(pixels, NUMBER) + step
    last = tf.cast(tf.shape(features)[1:3] - 1, NUMBER)
    place = tf.clip_by_value(found / 4, tf.zeros(2, NUMBER), last)
    descriptors = bilinear(features, place[None, :, 0], place[None, :, 1])[0]
    return found[:, ::-1], values, tf.nn.l2_normalize(descriptors, axis=-1)


def graph(weights, image):
    """Score map, raw outputs of conv6, and keypoints of a gray image (1, H, W, 1)."""
    size = tf.shape(image)[1:3]
    mean, variance = tf.nn.moments(image, [1, 2], keepdims=True)
    x = tf.nn.batch_normalization(image, mean, variance, None, None, EPSILON)
    x = normalised(weights, "conv0", conv(weights, "conv0", x, 32))
    raw = conv(weights, "conv1", x, 32)
    score = peakiness(weights, "conv1", raw, 3, size, 3.0) / 6
    x = normalised(weights, "conv1", raw)
    x = normalised(weights, "conv2", conv(weights, "conv2", x, 64, stride=2))
    raw = conv(weights, "conv3", x, 64)
    score += peakiness(weights, "conv3", raw, 2, size, 3.5) * 2 / 6
    x = normalised(weights, "conv3", raw)
    x = normalised(weights, "conv4", conv(weights, "conv4", x, 128, stride=2))
    x = normalised(weights, "conv5", conv(weights, "conv5", x, 128))
    for scope in ("conv6_0", "conv6_1"):
        x = normalised(weights, scope, deformable_conv(weights, scope, x, 128))
    features = deformable_conv(weights, "conv6", x, 128)
    score += peakiness(weights, "conv6", features, 1, size, 4.0) * 3 / 6
    return score, features, *keypoints(score, features)


def texture(size, seed):
    """A gray image with structures of several sizes, uint8."""
    random = np.random.default_rng(seed)
    noise = random.normal(size=size)
    frequency = np.hypot(np.fft.fftfreq(size[0])[:, None], np.fft.rfftfreq(size[1]))
    spectrum = np.fft.rfft2(noise) / (frequency + 0.03) * (frequency < 0.3)
    gray = np.fft.irfft2(spectrum, size)
    return np.clip(128 + 45 * gray / gray.std(), 0, 255).round().astype(np.uint8)


def main():
    with tf1.Graph().as_default(), tf1.Session() as session:
        placeholder = tf1.placeholder(tf.float32, (1, None, None, 1), name="input")
        outputs = graph(Weights(seed=0), tf.cast(placeholder, NUMBER))
        tf1.get_variable("global_step", initializer=np.int64(380_000), use_resource=False)
        session.run(tf1.global_variables_initializer())
        with tempfile.TemporaryDirectory() as folder:
            tf1.train.Saver().save(
                session, f"{folder}/{CHECKPOINT}", write_meta_graph=False, write_state=False
            )
            reader = tf.train.load_checkpoint(f"{folder}/{CHECKPOINT}")
            names = reader.get_variable_to_shape_map()
            variables = {name: reader.get_tensor(name) for name in names}
            np.savez_compressed(HERE / "variables.npz", **variables)
        arrays = {}
        for seed, (name, size) in enumerate(IMAGES.items()):
            image = texture(size, seed)
            found = session.run(outputs, {placeholder: image[None, :, :, None]})
            score, features, xy, scores, descriptors = found
            arrays[f"{name}/image"] = image
            arrays[f"{name}/score_map"] = score[0, :, :, 0].astype(np.float32)
            arrays[f"{name}/features"] = features[0].astype(np.float32)
            arrays[f"{name}/keypoints"] = xy.astype(np.float32)
            arrays[f"{name}/scores"] = scores.astype(np.float32)
            arrays[f"{name}/descriptors"] = descriptors.astype(np.float32)
            print(name, size, len(xy), score.min(), score.max(), features.std())
        np.savez_compressed(HERE / "reference.npz", **arrays)


if __name__ == "__main__":
    main()
