"""Parts of `bench stiffness`: small scenes, the Hessian by its products, Lanczos, needles, trainings, the report."""
