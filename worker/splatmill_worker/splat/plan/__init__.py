"""Facts about a scene, the decisions that follow from them, and the plan that training keeps to."""
