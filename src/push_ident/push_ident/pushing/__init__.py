"""Choose and check a push, plan and execute the motion of the arm, and cut streams into push records."""
