"""Writes the checkpoints of this folder with TensorFlow 2.21 (not a dependency of the project).

In an environment of its own: ``pip install tensorflow-cpu==2.21.0 && python make_bundles.py``.
``graph.ckpt-7`` is TF1's, written by ``tf.compat.v1.train.Saver``; ``object`` is TF2's, written by
``tf.train.Checkpoint``. ``tests/io/weights/test_tensorflow.py`` knows what they hold.
"""

from pathlib import Path

import numpy as np
import tensorflow as tf

HERE = Path(__file__).parent
tf1 = tf.compat.v1


def ramp(shape, dtype):
    """-1, -0.75, -0.5 ..."""
    count = int(np.prod(shape))
    return (np.arange(count) / 4 - 1).reshape(shape).astype(dtype)


def write_graph():
    """TF1: names of the graph, many that share a beginning, and every kind of number."""
    with tf1.Graph().as_default(), tf1.Session() as session:

        def variable(name, values, **how):
            tf1.get_variable(name, initializer=values, use_resource=False, **how)

        variable("conv0/kernel", ramp((3, 3, 1, 2), np.float32))
        for layer in range(12):
            for kind in ("moving_mean", "moving_variance"):
                variable(f"conv{layer}/bn/{kind}", ramp((layer,), np.float32) + layer)
        variable("tower/conv1/instance_max", np.float32(3.25))
        variable("global_step", np.int64(-7))
        for dtype in ("float64", "float16", "int32", "int16", "int8"):
            variable(f"kinds/{dtype}", ramp((2, 5), np.float64).astype(dtype))
        for dtype in ("uint8", "uint16", "uint32", "uint64"):
            variable(f"kinds/{dtype}", np.array([0, 1, np.iinfo(dtype).max], dtype))
        variable("kinds/bool", np.array([True, False, True]))
        variable("kinds/bfloat16", tf.cast(tf.constant([1.5, -2.25]), tf.bfloat16))
        variable("kinds/text", tf.constant(["one", "two"]))
        session.run(tf1.global_variables_initializer())
        tf1.train.Saver().save(
            session,
            str(HERE / "graph.ckpt"),
            global_step=7,
            write_meta_graph=False,
            write_state=False,
        )


def write_object():
    """TF2: names of attributes, and the graph of objects as a text among them."""
    module = tf.Module()
    module.kernel = tf.Variable(ramp((2, 3), np.float32))
    module.empty = tf.Variable(np.zeros((0, 4), np.float32))
    module.parts = [tf.Variable(np.float32(part)) for part in range(3)]
    tf.train.Checkpoint(model=module).write(str(HERE / "object"))


def write_slices():
    """TF1: a variable cut in slices, which our reader refuses."""
    with tf1.Graph().as_default(), tf1.Session() as session:
        tf1.get_variable(
            "sliced",
            shape=(4, 2),
            initializer=tf1.zeros_initializer(),
            use_resource=False,
            partitioner=tf1.fixed_size_partitioner(2),
        )
        session.run(tf1.global_variables_initializer())
        tf1.train.Saver().save(
            session, str(HERE / "sliced"), write_meta_graph=False, write_state=False
        )


if __name__ == "__main__":
    write_graph()
    write_object()
    write_slices()
