"""Held-out photographs are placed where they were, and the model stays as it is."""

from pathlib import Path

import numpy as np
import pycolmap

from tidefield.survey.sfm.placing import place


def test_photographs_are_placed_exactly_by_exact_matches_and_others_are_left_out(tmp_path: Path):
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 8, 200
    database = tmp_path / "database.db"
    with pycolmap.Database.open(database) as db:
        truth = pycolmap.synthesize_dataset(options, db)
        numbers = {name: number for number, name in sorted((i, truth.image(i).name) for i in truth.reg_image_ids())}
        names = {image.image_id: image.name for image in db.read_all_images()}
    held_out, lonely = (truth.image(i) for i in sorted(numbers.values())[:2])
    model = pycolmap.Reconstruction(truth)
    for image in (held_out, lonely):
        model.deregister_frame(image.frame_id)
    model.write_binary(tmp_path)
    model = pycolmap.Reconstruction(tmp_path)
    with pycolmap.Database.open(database) as db:
        for other in names:
            if other != lonely.image_id:
                db.delete_two_view_geometry(lonely.image_id, other)
    before = {number: point.xyz.copy() for number, point in model.points3D.items()}
    assert place(model, database, {held_out.name, lonely.name}, lambda *_: None) == {lonely.name: 0}
    images = {model.image(i).name: model.image(i) for i in model.reg_image_ids()}
    assert images.keys() == numbers.keys() - {lonely.name}
    for name, image in images.items():
        true = truth.image(numbers[name])
        np.testing.assert_allclose(image.projection_center(), true.projection_center(), atol=1e-4)
        np.testing.assert_allclose(image.viewing_direction(), true.viewing_direction(), atol=1e-4)
    assert all((model.points3D[number].xyz == xyz).all() for number, xyz in before.items())
