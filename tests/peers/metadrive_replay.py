"""Replays a ScenarioNet folder in MetaDrive without rendering and prints every agent's pose at every step as JSON.

Runs in an environment of its own: `python metadrive_replay.py FOLDER`.
"""

from __future__ import annotations

import json
import sys

from metadrive.envs.scenario_env import ScenarioEnv
from metadrive.policy.replay_policy import ReplayEgoCarPolicy
from metadrive.scenario.scenario_description import ScenarioDescription


class WholeEpisode(ScenarioEnv):
    """Plays to the last step; the original stops as soon as the ego is near the end of its route."""

    def done_function(self, vehicle_id):
        return False, super().done_function(vehicle_id)[1]


def poses(env, scenario):
    """x, y, heading and velocity of everything that is in the world, by the id that it has in the file."""
    objects = env.engine.get_objects()
    shown = {name: objects[key] for name, key in env.engine.traffic_manager.scenario_id_to_obj_id.items()}
    moved = scenario["metadata"].get("old_origin_in_current_coordinate", (0.0, 0.0))  # by MetaDrive itself
    dx, dy = (offset - m for offset, m in zip(scenario["metadata"]["position_offset_m"], moved))
    return {
        name: [o.position[0] + dx, o.position[1] + dy, o.heading_theta, *map(float, o.velocity)]
        for name, o in shown.items()
    }


def main(folder):
    settings = {"use_render": False, "data_directory": folder, "num_scenarios": 1, "log_level": 50}
    env = WholeEpisode({**settings, "agent_policy": ReplayEgoCarPolicy})
    env.reset(seed=0)
    scenario = env.engine.data_manager.current_scenario
    ScenarioDescription.sanity_check(dict(scenario), check_self_type=True, valid_check=False)
    steps = [poses(env, scenario)]
    for _ in range(scenario["length"] - 1):
        env.step([0, 0])
        steps.append(poses(env, scenario))
    env.close()
    json.dump(steps, sys.stdout, default=float)


main(sys.argv[1])
