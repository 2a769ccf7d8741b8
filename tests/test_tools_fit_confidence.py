"""The tool that fits confidence: known weights are found again, signs are kept, and simulated detectors err as they should."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from fits import confidence as fit_confidence
from fits import confidence_logs

from log2sim.datatypes import Frame

pytestmark = pytest.mark.slow


@pytest.mark.slow
def test_agents_of_a_synthetic_log_are_rated_and_its_detector_errs(tmp_path):
    log, scene, true = confidence_logs.make_log(1, 0)
    detector = confidence_logs.SimulatedDetector(log, scene, true, 3)
    camera, stamp = log.cameras["camera"], int(log.streams["camera"].t_ns[3])
    frame = Frame(camera, stamp, lambda: np.zeros((camera.height_px, camera.width_px, 3), np.uint8))
    one, two = detector.detect(frame), detector.detect(frame)
    np.testing.assert_array_equal(one.box_px, two.box_px)
    assert len(one)
    assert one.score.min() >= confidence_logs.MIN_SCORE
    cases = pickle.loads(pickle.dumps(confidence_logs.cases_of(1, 0)))
    agents = [agent for case in cases for agent in fit_confidence.agents_of(case, "one")]
    assert [sum(a.lidar == lidar for a in agents) > 3 for lidar in (True, False)] == [True, True]
    assert all(0 <= a.right <= a.there <= 1 and a.ticks > 0 for a in agents)
    assert np.isfinite([list(a.evidence.values()) for a in agents]).all()
    there, p = fit_confidence.probabilities(agents, fit_confidence.fit_there_and_right(agents))
    assert ((p > 0) & (p < 1) & (there < 1)).all()
    assert set(fit_confidence.fit_all_variances(agents, p)) == {"sigma_xy_m", "sigma_yaw_rad", "sigma_speed_mps"}
