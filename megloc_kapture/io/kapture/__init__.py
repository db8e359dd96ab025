"""The kapture store: all that other rooms use of it, under one name.

The format is parsed and written by the modules of this package, strictly and fast. kapture itself
is needed only by who wants its objects (:func:`to_kapture`), and imported there alone: that takes a
second.
"""

from megloc_kapture.io.kapture.data import (
    KaptureData as KaptureData,
)
from megloc_kapture.io.kapture.data import (
    Sensor as Sensor,
)
from megloc_kapture.io.kapture.features import (
    FeatureConfig as FeatureConfig,
)
from megloc_kapture.io.kapture.features import (
    FeatureKind as FeatureKind,
)
from megloc_kapture.io.kapture.features import (
    FeatureReader as FeatureReader,
)
from megloc_kapture.io.kapture.features import (
    FeatureWriter as FeatureWriter,
)
from megloc_kapture.io.kapture.features import (
    feature_folder as feature_folder,
)
from megloc_kapture.io.kapture.folder import (
    KaptureFolder as KaptureFolder,
)
from megloc_kapture.io.kapture.folder import (
    to_kapture as to_kapture,
)
from megloc_kapture.io.kapture.matches import (
    ImagePair as ImagePair,
)
from megloc_kapture.io.kapture.matches import (
    MatchesReader as MatchesReader,
)
from megloc_kapture.io.kapture.matches import (
    MatchesWriter as MatchesWriter,
)
from megloc_kapture.io.kapture.matches import (
    read_pairs as read_pairs,
)
from megloc_kapture.io.kapture.matches import (
    write_pairs as write_pairs,
)
from megloc_kapture.io.kapture.observations import (
    Observations as Observations,
)
from megloc_kapture.io.kapture.observations import (
    write_observations as write_observations,
)
from megloc_kapture.io.kapture.points import (
    read_point_covariances as read_point_covariances,
)
from megloc_kapture.io.kapture.points import (
    write_point_covariances as write_point_covariances,
)
from megloc_kapture.io.kapture.points import (
    write_points3d as write_points3d,
)
from megloc_kapture.io.kapture.sensors import (
    unit_quaternion as unit_quaternion,
)
from megloc_kapture.io.kapture.sensors import (
    write_sensors as write_sensors,
)
from megloc_kapture.io.kapture.text import (
    writable_name as writable_name,
)
from megloc_kapture.io.kapture.vectors import (
    KaptureVectors as KaptureVectors,
)
