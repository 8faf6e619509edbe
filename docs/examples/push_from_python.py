"""Push the object of a running cell twice at random, and say what was predicted and what was seen."""

import numpy as np

from push_ident.geometry.cells import cell_error
from push_ident.nodes.client.cell_client import CellClient
from push_ident_msgs.action import ExecutePush

with CellClient() as cell:
    object_id = cell.wait_for_object()
    for seed in (1, 2):
        # Plan first: the path of the tool is what a prediction needs. The arm does not move.
        plan = cell.execute_push(ExecutePush.Goal(mode=ExecutePush.Goal.MODE_RANDOM, object_id=object_id, seed=seed, dry_run=True))
        if plan.error_code != ExecutePush.Result.NONE:
            print(f"no push: {plan.error_text}")
            continue
        end = cell.predict(object_id, plan.tool_path).poses[-1].pose
        predicted = np.array([end.position.x, end.position.y, 2 * np.arctan2(end.orientation.z, end.orientation.w)])
        goal = ExecutePush.Goal(mode=ExecutePush.Goal.MODE_CONTACT, object_id=object_id)
        goal.contact_point, goal.direction, goal.distance, goal.speed = plan.contact_point, plan.direction, plan.distance, plan.speed
        done = cell.execute_push(goal)
        seen = cell.pose_at_rest(object_id, after=cell.poses(object_id)[-1][0])
        error = cell_error(cell.shape(object_id).cells, predicted, seen)
        print(f"push {seed}: {done.error_text or 'made'}; predicted to {1e3 * error:.1f} mm")
