"""What all tests of surveys share."""

from collections.abc import Iterator

import pycolmap
import pytest

from tidefield.survey.georeference import bundle_adjustment


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """With several threads, pycolmap adds up in an order that changes with the load of the machine."""
    pipeline, adjustment = pycolmap.IncrementalPipelineOptions, bundle_adjustment.adjustment_options

    def of_mapping() -> pycolmap.IncrementalPipelineOptions:
        options = pipeline()
        options.num_threads = 1
        return options

    def of_adjustment() -> pycolmap.BundleAdjustmentOptions:
        options = adjustment()
        solver = options.ceres.solver_options
        solver.num_threads = 1
        options.ceres.solver_options = solver
        return options

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pycolmap, "IncrementalPipelineOptions", of_mapping)
        patch.setattr(bundle_adjustment, "adjustment_options", of_adjustment)
        yield
