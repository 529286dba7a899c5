"""The hard cases, and the tests that hold them: what docs/hard-cases.md is made of."""

from __future__ import annotations

_ = "tests/hard/test_"
_CORE = "tests/core/"
_FAULTS = "tests/faults/test_"

# Section, then (case, its tests). A test is FILE::FUNCTION, all of its variants.
CASES: dict[str, tuple[tuple[str, tuple[str, ...]], ...]] = {
    "Geometry": (
        (
            "faces without area, used twice, loose vertices",
            (
                f"{_}geometry.py::test_faces_without_area_and_loose_vertices_change_nothing",
                f"{_}geometry.py::test_duplicate_faces_change_nothing",
            ),
        ),
        (
            "coordinates that are NaN or infinite, meshes of every kind of damage",
            ("tests/adapters/test_meshes.py::test_bad_files_are_refused_by_name", f"{_}geometry.py::test_hard_meshes"),
        ),
        (
            "sizes 1e-6 to 1e6, and powers of two to the bit",
            (f"{_}geometry.py::test_scale", f"{_}invariants.py::test_size", f"{_}paths.py::test_any_size"),
        ),
        ("far from the origin", (f"{_}geometry.py::test_far_from_the_origin",)),
        (
            "things in each other, in one plane, in one place",
            (
                f"{_}geometry.py::test_interpenetrating_objects",
                f"{_}geometry.py::test_two_objects_in_one_place",
                f"{_CORE}transport/test_buried.py::test_*",
            ),
        ),
        ("inconsistent winding", (f"{_}geometry.py::test_inconsistent_winding",)),
        (
            "one triangle",
            (f"{_}geometry.py::test_one_triangle", f"{_}assets.py::test_a_region_of_one_triangle_changes_alone"),
        ),
        ("a million triangles", (f"{_}large.py::test_a_million_triangles",)),
        ("any soup of triangles", (f"{_}properties.py::test_meshes",)),
        ("cameras inside things and looking away", (f"{_}geometry.py::test_cameras_inside_and_away",)),
    ),
    "Light": (
        (
            "black, constant, 1 x 1",
            (
                f"{_}light.py::test_black",
                f"{_}light.py::test_one_pixel_map_is_the_constant_map",
                f"{_}paths.py::test_black_and_one_pixel",
                f"{_}light.py::test_constant_sky_gives_lambert_its_albedo_where_nothing_blocks",
            ),
        ),
        (
            "a sun of 1e6 in one texel, at seams and poles",
            (
                f"{_}light.py::test_one_texel_sun",
                f"{_}paths.py::test_sun_beside_a_dark_sky",
                f"{_}light.py::test_texels_at_the_poles_count_by_their_solid_angle",
            ),
        ),
        (
            "negative, infinite and NaN pixels",
            (
                f"{_}light.py::test_negative_pixels_are_taken_as_black",
                f"{_}light.py::test_pixels_that_are_no_light_are_refused",
            ),
        ),
        ("any map", (f"{_}properties.py::test_maps",)),
    ),
    "Reflectance": (
        (
            "roughness 1e-4 to 10, exponents 0 to 1e6, f0 0 and 1, under even light and a sun",
            (
                f"{_}light.py::test_reflectances",
                f"{_}light.py::test_reflectances_by_the_reference",
                f"{_}paths.py::test_materials_at_their_extremes",
                f"{_}assets.py::test_extremes_are_bounded_and_near_the_transfer_store",
            ),
        ),
        ("grazing light and view", (f"{_}light.py::test_specular_light_is_linear_and_non_negative_at_grazing",)),
        ("energy above 1 is told", ("tests/scene/test_parse.py::test_too_much_energy_is_allowed_and_noted",)),
        (
            "reciprocity",
            (
                f"{_CORE}brdf/test_models.py::test_reciprocity",
                f"{_}assets.py::test_transport_between_two_regions_is_reciprocal",
            ),
        ),
        (
            "points outside of what was measured",
            (
                f"{_CORE}brdf/test_navigation.py::test_outside_it_is_the_nearest_point_of_the_hull",
                f"{_CORE}brdf/test_navigation.py::test_the_mix_is_continuous_across_the_hull",
            ),
        ),
        ("any edit", (f"{_}properties.py::test_edits", f"{_}properties.py::test_edits_that_make_no_sense")),
    ),
    "Linear algebra": (
        (
            "rank-deficient, constant, zero, singular values across 1e-12, more rank than data",
            (
                f"{_}properties.py::test_ranks_of_tensors",
                f"{_CORE}compress/test_tucker.py::test_tiny_and_constant_tensors",
                f"{_CORE}compress/test_tucker.py::test_the_zero_tensor",
                f"{_}assets.py::test_more_rank_than_the_data_has_leaves_rounding_alone",
            ),
        ),
        (
            "fewer samples than clusters, empty clusters, duplicates",
            (
                f"{_}properties.py::test_clusters_of_rows",
                f"{_CORE}compress/test_cpca.py::test_more_clusters_and_terms_than_the_data_have",
            ),
        ),
    ),
    "Functions on the sphere": (
        (
            "ringing",
            (
                f"{_CORE}sphere/test_window.py::test_hemisphere_stays_between_nothing_and_all",
                f"{_CORE}sphere/test_window.py::test_kernel_is_nowhere_negative",
            ),
        ),
        ("fifty occluders in a row", (f"{_CORE}fields/test_light.py::test_fifty_occluders_in_a_row",)),
        ("rotation by 0 and 180 degrees", (f"{_CORE}sphere/test_rotation.py::test_nothing_is_singular",)),
        ("M^alpha at alpha = 0 and 1e6", (f"{_CORE}pose/test_phong_operator.py::test_entries_equal_quadrature",)),
    ),
    "Moving things": (
        (
            "a receiver inside, on a sphere of samples, outside the last one; two things in one place",
            (
                f"{_}moved.py::test_light_is_bounded_wherever_things_are_put",
                f"{_}moved.py::test_what_is_far_away_is_not_there",
                f"{_}moved.py::test_two_things_in_one_place_are_at_worst_black",
            ),
        ),
        ("the order of names", (f"{_}moved.py::test_order_of_names_does_not_matter",)),
        ("light through a wall", (f"{_CORE}fields/test_light.py::test_no_light_through_a_wall",)),
    ),
    "Poses": (
        ("fewer frames than joints", (f"{_CORE}pose/test_linear_model.py::test_fewer_frames_than_features",)),
        (
            "collinear joints, a joint that never moves",
            (
                f"{_CORE}pose/test_linear_model.py::test_constant_and_collinear_features",
                f"{_CORE}pose/test_rig.py::test_what_never_moves_is_no_feature",
            ),
        ),
        (
            "lobe axes across the wrap-around and through the pole",
            (f"{_CORE}pose/test_pose_model.py::test_axis_through_the_pole",),
        ),
        (
            "lobes that swap or become one",
            (
                f"{_CORE}pose/test_zh_lobes.py::test_lobes_keep_their_identity",
                f"{_CORE}pose/test_zh_lobes.py::test_two_lobes_that_are_one",
            ),
        ),
        ("a skin that collapses", (f"{_CORE}pose/test_rig.py::test_a_skin_that_collapses_still_has_frames",)),
    ),
    "Files": (
        (
            "truncated, emptied, deleted, flipped bits, chunks exchanged",
            (
                f"{_FAULTS}damage.py::test_every_file_is_guarded",
                f"{_FAULTS}damage.py::test_exchanged_chunks",
                f"{_FAULTS}damage.py::test_files_that_do_not_belong",
            ),
        ),
        ("of another version", (f"{_FAULTS}damage.py::test_another_version",)),
        (
            "of another scene or settings, or changed midway",
            (
                f"{_FAULTS}damage.py::test_other_inputs_or_settings",
                f"{_FAULTS}damage.py::test_an_input_changed_while_work_was_interrupted",
                f"{_FAULTS}damage.py::test_an_input_changed_while_it_was_read",
            ),
        ),
        (
            "read-only, unreadable, a full disk",
            (
                f"{_FAULTS}machine.py::test_read_only_folder",
                f"{_FAULTS}machine.py::test_unreadable_inputs",
                f"{_FAULTS}machine.py::test_full_disk",
                f"{_FAULTS}machine.py::test_full_disk_under_a_picture",
            ),
        ),
        (
            "two writers",
            (f"{_FAULTS}kill.py::test_two_writers", f"{_FAULTS}pictures.py::test_two_relights_at_once"),
        ),
        (
            "killed at any moment",
            (
                f"{_FAULTS}kill.py::test_killed_at_random_moments",
                f"{_FAULTS}kill.py::test_interrupted",
                f"{_FAULTS}pictures.py::test_killed_while_writing_a_sequence",
                f"{_FAULTS}campaign.py::test_a_sample",
            ),
        ),
        (
            "from strangers: every parser on changed files",
            (
                f"{_FAULTS}fuzz.py::test_changed_files_are_read_or_refused",
                "tests/formats/test_untrusted.py::test_*",
            ),
        ),
    ),
    "Invariants": (
        (
            "furnace",
            (
                f"{_}invariants.py::test_white_under_a_white_sky",
                f"{_}geometry.py::test_furnace_over_anything_convex",
                f"{_}assets.py::test_white_closed_box_is_bounded",
                f"{_}paths.py::test_white_is_not_brighter_than_its_sky",
            ),
        ),
        (
            "linear in the light",
            (
                f"{_}invariants.py::test_linear_in_brightness",
                f"{_}invariants.py::test_sum_of_two_skies",
                f"{_}light.py::test_light_is_linear_in_brightness",
                f"{_}paths.py::test_brightness",
                f"{_}paths.py::test_two_skies",
            ),
        ),
        (
            "layers add up",
            (f"{_}invariants.py::test_layers_add_up_to_the_picture", f"{_}paths.py::test_layers_add_up"),
        ),
        (
            "scene and sky turned together",
            (f"{_}invariants.py::test_scene_and_sky_turn_together", f"{_}paths.py::test_turned_with_its_sky"),
        ),
        (
            "order of vertices and of faces",
            (f"{_}invariants.py::test_order_in_the_file", f"{_}paths.py::test_any_order"),
        ),
        (
            "what no light reaches neither gets nor gives",
            (f"{_}assets.py::test_what_no_light_reaches_neither_gets_nor_gives",),
        ),
    ),
}


def nodes() -> list[str]:
    """All tests that are named, each once."""
    found = [test for cases in CASES.values() for _case, tests in cases for test in tests]
    return list(dict.fromkeys(found))
