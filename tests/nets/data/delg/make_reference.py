"""Writes this folder's files with TensorFlow 2.15 (not a dependency of the project).

In a separate environment::

    pip install tensorflow-cpu==2.15.1 tf_keras==2.15.0 tf_slim==1.1.0
    TF_USE_LEGACY_KERAS=1 python make_reference.py

The Keras network has the structure and the attributes that the public training code of DELG has;
it is exported as the public exporter does. The TF-Slim one is resnet_v1_50 of that library, with
the same head; it is saved as a graph of TF1 is. ``keras.txt`` (exported model),
``keras-weights.txt`` (checkpoint of the training) and ``slim.txt`` hold the names and shapes of the
variables as TensorFlow wrote them, ``reference.npz`` the vectors of one image at
each scale. ``tests/nets/published.py`` makes the same weights, ``test_delg.py`` the image.
"""

import shutil
import sys
import tempfile
import zlib
from pathlib import Path

import numpy as np
import tensorflow as tf
import tf_slim
from tf_keras.src import legacy_tf_layers
from tf_keras.src.legacy_tf_layers import normalization
from tf_slim.nets import resnet_v1

# where TensorFlow looks for what TF-Slim asks it for
sys.modules["tf_keras.legacy_tf_layers"] = legacy_tf_layers
sys.modules["tf_keras.legacy_tf_layers.normalization"] = normalization

HERE = Path(__file__).parent
SCALES = (0.70710677, 1.0, 1.4142135)
BLOCKS = {2: 3, 3: 4, 4: 6, 5: 3}
layers = tf.keras.layers
tf1 = tf.compat.v1


def values_of(name, shape):
    """Values of a variable that keep activations near 1."""
    random = np.random.RandomState(zlib.crc32(name.encode()))
    if len(shape) > 1:
        fan_in = int(np.prod(shape[:-1]))
        return (random.standard_normal(shape) * np.sqrt(2 / fan_in)).astype(np.float32)
    low, high = {"e": (0.5, 2.0), "a": (0.3, 0.7)}.get(kind_of(name), (-0.2, 0.2))
    return random.uniform(low, high, shape).astype(np.float32)


def kind_of(name):
    """e for a variance, a for a scale, empty for a mean or an offset."""
    word = name.removesuffix("/.ATTRIBUTES/VARIABLE_VALUE").rpartition("/")[2]
    if word.isdigit():  # of a block: convolutions and norms in turn
        words = ("kernel", "bias", "gamma", "beta", "moving_mean", "moving_variance")
        word = words[int(word) % 6]
    return {"moving_variance": "e", "gamma": "a"}.get(word, "")


def image():
    """RGB of odd and even sides."""
    return np.random.RandomState(0).randint(0, 256, (101, 134, 3)).astype(np.uint8)


def pooled(features):
    cubes = tf.pow(tf.maximum(features, 1e-6), 3.0)
    return tf.pow(tf.reduce_mean(cubes, axis=[1, 2]), 1 / 3.0)


def at_scale(scale):
    normalised = (tf.cast(image(), tf.float32) - 128.0) / 128.0
    size = tf.cast(tf.round(tf.cast(image().shape[:2], tf.float32) * scale), tf.int32)
    return tf.image.resize(normalised[None], size)


class Block(tf.keras.Model):
    def __init__(self, width, strides, has_shortcut):
        super().__init__()
        self.conv2a = layers.Conv2D(width, 1, strides=strides)
        self.bn2a = layers.BatchNormalization()
        self.conv2b = layers.Conv2D(width, 3, padding="same")
        self.bn2b = layers.BatchNormalization()
        self.conv2c = layers.Conv2D(4 * width, 1)
        self.bn2c = layers.BatchNormalization()
        self.has_shortcut = has_shortcut
        if has_shortcut:
            self.conv_shortcut = layers.Conv2D(4 * width, 1, strides=strides)
            self.bn_shortcut = layers.BatchNormalization()

    def call(self, x, training=False):
        y = tf.nn.relu(self.bn2a(self.conv2a(x), training=training))
        y = tf.nn.relu(self.bn2b(self.conv2b(y), training=training))
        y = self.bn2c(self.conv2c(y), training=training)
        if self.has_shortcut:
            x = self.bn_shortcut(self.conv_shortcut(x), training=training)
        return tf.nn.relu(x + y)


class Backbone(tf.keras.Model):
    def __init__(self):
        super().__init__()
        self.conv1 = layers.Conv2D(64, 7, strides=2, padding="same")
        self.bn_conv1 = layers.BatchNormalization()
        self.max_pool = layers.MaxPooling2D(3, strides=2)
        for stage, count in BLOCKS.items():
            for number in range(count):
                strides = 2 if stage > 2 and number == 0 else 1
                block = Block(16 * 2**stage, strides, number == 0)
                setattr(self, f"l{stage}{'abcdef'[number]}", block)
        self.embedding_layer = layers.Dense(2048)

    def build_call(self, x, training=False):
        x = self.max_pool(tf.nn.relu(self.bn_conv1(self.conv1(x), training=training)))
        for stage, count in BLOCKS.items():
            for number in range(count):
                x = getattr(self, f"l{stage}{'abcdef'[number]}")(x, training=training)
        return self.embedding_layer(pooled(x))

    def call(self, x, training=False):
        return self.build_call(x, training)


class Attention(tf.keras.Model):
    def __init__(self):
        super().__init__()
        self.conv1 = layers.Conv2D(512, 1)
        self.bn_conv1 = layers.BatchNormalization()
        self.conv2 = layers.Conv2D(1, 1)

    def call(self, x, training=False):
        return self.conv2(tf.nn.relu(self.bn_conv1(self.conv1(x), training=training)))


class Delg(tf.keras.Model):
    def __init__(self):
        super().__init__()
        self.backbone = Backbone()
        self.attention = Attention()

    def call(self, x, training=False):
        self.attention(tf.zeros((1, 3, 3, 1024)))
        return self.backbone.build_call(x, training)


class Module(tf.Module):
    def __init__(self):
        super().__init__()
        self._model = Delg()

    @tf.function(input_signature=[tf.TensorSpec((None, None, None, 3), tf.float32)])
    def extract(self, x):
        self._model.attention(tf.zeros((1, 3, 3, 1024)), training=False)
        return self._model.backbone.build_call(x, training=False)


def write_names(path, checkpoint):
    """Names and shapes of numbers; the graph of objects is a text."""
    reader = tf.train.load_checkpoint(checkpoint)
    shapes, types = reader.get_variable_to_shape_map(), reader.get_variable_to_dtype_map()
    rows = [
        f"{name} {'x'.join(map(str, shapes[name])) or 'scalar'}\n"
        for name in sorted(shapes)
        if types[name] != tf.string
    ]
    path.write_text("".join(rows))
    return {row.split()[0]: shapes[row.split()[0]] for row in rows}


def keras_vectors():
    module = Module()
    module.extract(at_scale(1.0))
    folder = Path(tempfile.mkdtemp())
    tf.saved_model.save(module, str(folder))
    names = write_names(HERE / "keras.txt", str(folder / "variables" / "variables"))
    module._model.save_weights(str(folder / "weights"))
    write_names(HERE / "keras-weights.txt", str(folder / "weights"))
    for name in names:
        if "/backbone/" not in name:
            continue
        place = module
        for attribute in name.removesuffix("/.ATTRIBUTES/VARIABLE_VALUE").split("/"):
            is_row = attribute.isdigit()
            place = place[int(attribute)] if is_row else getattr(place, attribute)
        place.assign(values_of(name, tuple(place.shape)))
    shutil.rmtree(folder)
    return [module.extract(at_scale(scale)).numpy()[0] for scale in SCALES]


def slim_vectors():
    with tf1.Graph().as_default(), tf1.Session() as session:
        found = []
        for scale in SCALES:
            with tf_slim.arg_scope(resnet_v1.resnet_arg_scope()):
                _, ends = resnet_v1.resnet_v1_50(
                    at_scale(scale),
                    num_classes=None,
                    is_training=False,
                    global_pool=False,
                    reuse=bool(found),
                )
            features = ends["resnet_v1_50/block4"]
            with tf1.variable_scope("whitening", reuse=bool(found)):
                weights = tf1.get_variable("weights", (1, 1, 2048, 2048))
                biases = tf1.get_variable("biases", (2048,))
            found.append(pooled(features) @ weights[0, 0] + biases)
        with tf1.variable_scope("attention"):
            tf1.get_variable("conv1/weights", (1, 1, 1024, 512))
        session.run(tf1.global_variables_initializer())
        folder = Path(tempfile.mkdtemp())
        tf1.train.Saver().save(session, str(folder / "variables"))
        write_names(HERE / "slim.txt", str(folder / "variables"))
        shutil.rmtree(folder)
        for variable in tf1.global_variables():
            name = variable.op.name
            variable.load(values_of(name, tuple(variable.shape.as_list())), session)
        return [vector[0] for vector in session.run(found)]


if __name__ == "__main__":
    np.savez(HERE / "reference.npz", keras=np.stack(keras_vectors()), slim=np.stack(slim_vectors()))
