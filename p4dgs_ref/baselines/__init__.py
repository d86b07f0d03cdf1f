"""The methods that the paper compares itself with, trained by the same loop and renderer.

    from p4dgs_ref import baselines
    model = baselines.train(scene, "d3dgs", seed=0)
    sizes = model.save("bouncing.ply")
    model = baselines.load("bouncing.ply")

A method is a module with its equations, PRESETS, a model and a Trainer.
"""
