"""Weights of networks: the folder they lie in, their sha256, their tensors, read safely."""

from megloc_kapture.io.weights.folder import (
    FOLDER_VARIABLE as FOLDER_VARIABLE,
)
from megloc_kapture.io.weights.folder import (
    SOURCE_KEY as SOURCE_KEY,
)
from megloc_kapture.io.weights.folder import (
    UNVERIFIED as UNVERIFIED,
)
from megloc_kapture.io.weights.folder import (
    MissingWeightsError as MissingWeightsError,
)
from megloc_kapture.io.weights.folder import (
    WeightsFile as WeightsFile,
)
from megloc_kapture.io.weights.folder import (
    add_weights as add_weights,
)
from megloc_kapture.io.weights.folder import (
    all_missing as all_missing,
)
from megloc_kapture.io.weights.folder import (
    check_sha256 as check_sha256,
)
from megloc_kapture.io.weights.folder import (
    convert_weights as convert_weights,
)
from megloc_kapture.io.weights.folder import (
    describe as describe,
)
from megloc_kapture.io.weights.folder import (
    files_of as files_of,
)
from megloc_kapture.io.weights.folder import (
    find_all_weights as find_all_weights,
)
from megloc_kapture.io.weights.folder import (
    find_weights as find_weights,
)
from megloc_kapture.io.weights.folder import (
    how_to_get as how_to_get,
)
from megloc_kapture.io.weights.folder import (
    prove as prove,
)
from megloc_kapture.io.weights.folder import (
    read_weights as read_weights,
)
from megloc_kapture.io.weights.folder import (
    sha256_of as sha256_of,
)
from megloc_kapture.io.weights.folder import (
    share_weights as share_weights,
)
from megloc_kapture.io.weights.folder import (
    weights_folder as weights_folder,
)
