"""Every script of benchmarks/ is run by a test, on an input as small as it takes; its page says how it is called."""

from __future__ import annotations

import importlib
import re

import pytest

from benchmark_scripts import BENCHMARKS, run_script
from places import TESTS

# Script: the test that runs it, of several the one that runs most of it.
RUN_BY = {
    "acceptance.py": "test_acceptance.py::test_a_row_of_the_acceptance_table",
    "audit.py": "test_acceptance.py::test_known_vulnerabilities_are_found",
    "baselines.py": "test_surfaces.py::test_the_benchmark_of_other_methods",
    "before_after.py": "test_real_images.py::test_figures_before_and_after_a_change_stand_side_by_side",
    "bench_kernels.py": "test_speed.py::test_the_benchmarks_of_the_kernels",
    "bench_linescan.py": "test_speed.py::test_the_benchmarks_of_the_kernels",
    "bench_orientation.py": "test_speed.py::test_the_benchmarks_of_the_kernels",
    "rows/other_programs.py": "test_acceptance.py::test_the_rows_of_other_programs_are_those_of_their_last_run",
    "conftest.py": "test_speed.py::test_the_benchmarks_of_the_kernels",
    "cloud_files.py": "test_speed.py::test_files_of_points_are_compared",
    "coregistration.py": "test_acceptance.py::test_planted_shifts_are_found",
    "rows/departures.py": "test_departures_row.py::test_a_function_is_replaced_while_the_surface_is_made",
    "displaced_windows.py": "test_ortho_images_row.py::test_a_displaced_ortho_image_is_judged",
    "double_mapping.py": "test_surfaces.py::test_cells_that_show_what_hides_them",
    "frame_block.py": "test_frame_block.py::test_a_block_is_planned_and_a_part_of_it_matched",
    "inspecting.py": "test_speed.py::test_clicks_on_a_surface_are_timed",
    "judging.py": "test_surfaces.py::test_the_benchmark_of_the_choice_of_views",
    "independent_surfaces.py": "test_real_images.py::test_two_surfaces_disagree_in_exactly_the_planted_share",
    "large.py": "test_speed.py::test_growth_is_measured_and_kept",
    "rows/joined.py": "test_joined_row.py::test_runs_are_joined_and_changed",
    "rows/large_areas.py": "test_speed.py::test_what_a_wider_halo_changes",
    "lines_of_sight.py": "test_real_images.py::test_a_tower_occludes_what_lies_behind_it_in_a_view_with_rpc",
    "machine.py": "test_speed.py::test_rates_of_a_core_are_measured",
    "pages/scene_tables.py": "test_realistic_scenes.py::test_tables_of_realistic_scenes",
    "marked_cells.py": "test_realistic_scenes.py::test_errors_in_marked_cells",
    "peers/realistic.py": "test_realistic_scenes.py::test_scenes_of_seeds_are_rendered_and_judged",
    "peers/verdicts.py": "test_realistic_scenes.py::test_the_heaviest_loss_comes_first_with_its_reason",
    "rows/realistic.py": "test_realistic_scenes.py::test_how_hard_the_recipe_is_for_others",
    "rows/flags.py": "test_surfaces.py::test_what_a_warning_is_worth_is_counted",
    "rows/clouds.py": "test_realistic_scenes.py::test_a_cloud_is_masked_and_judged",
    "rows/troubles.py": "test_realistic_scenes.py::test_a_trouble_is_matched_and_judged",
    "middlebury.py": "test_acceptance.py::test_the_benchmark_of_rectified_photographs",
    "pages/__init__.py": "test_figures.py::test_the_pages_show_their_results",
    "pages/__main__.py": "test_figures.py::test_the_command_tells_what_differs",
    "pages/all_pages.py": "test_figures.py::test_the_pages_show_their_results",
    "pages/numbers.py": "test_figures.py::test_the_pages_show_their_results",
    "pages/spans.py": "test_figures.py::test_the_pages_show_their_results",
    "pages/tables.py": "test_figures.py::test_the_pages_show_their_results",
    "peers/__main__.py": "test_peers_command.py::test_zlocus_alone_is_compared_with_the_truth",
    "peers/isd.py": "test_peers.py::test_setsm_is_told_where_the_satellite_was",
    "peers/builds.py": "test_peers.py::test_micmac_as_its_documents_say",
    "peers/cars.py": "test_peers_command.py::test_cars_is_run_with_its_configuration",
    "peers/environments.py": "test_peers_command.py::test_an_environment_is_made_once_for_what_is_wanted",
    "peers/frames.py": "test_peers_frames.py::test_frames_are_matched_and_judged",
    "peers/launch.py": "test_peers.py::test_all_that_is_started_counts",
    "peers/match_opencv.py": "test_peers.py::test_a_matcher_of_rows_finds_a_surface",
    "peers/match_pandora.py": "test_peers_command.py::test_disparities_of_pandora_point_to_the_left",
    "peers/matchers.py": "test_peers.py::test_a_matcher_of_rows_finds_a_surface",
    "peers/measuring.py": "test_peers.py::test_all_that_is_started_counts",
    "peers/middlebury.py": "test_peers_command.py::test_photographs_are_matched_by_all",
    "peers/own.py": "test_peers_command.py::test_zlocus_alone_is_compared_with_the_truth",
    "peers/page.py": "test_peers_command.py::test_the_command_writes_the_page_of_results",
    "peers/pairs.py": "test_peers.py::test_a_matcher_of_rows_finds_a_surface",
    "peers/results.py": "test_peers_command.py::test_zlocus_alone_is_compared_with_the_truth",
    "peers/running.py": "test_peers_command.py::test_zlocus_alone_is_compared_with_the_truth",
    "peers/scenes.py": "test_peers_command.py::test_zlocus_alone_is_compared_with_the_truth",
    "peers/sgm_speed.py": "test_peers_command.py::test_aggregation_is_timed_beside_other_programs",
    "processors.py": "test_processors.py::test_libraries_for_other_processors_make_the_same_bytes",
    "precision.py": "test_surfaces.py::test_standard_deviations_are_calibrated",
    "rows/standard_deviations.py": "test_surfaces.py::test_shares_within_sigma_by_recipe",
    "recording.py": "test_result_files.py::test_the_tables_that_a_script_prints_are_kept",
    "rectifying.py": "test_surfaces.py::test_the_benchmark_of_other_methods",
    "reprojection.py": "test_acceptance.py::test_images_left_out_confirm_a_surface",
    "roofline.py": "test_speed.py::test_the_roofline_of_a_kernel_and_of_the_program",
    "roofline_counts.py": "test_speed.py::test_bounds_follow_from_counts",
    "result_files.py": "test_result_files.py::test_a_measured_row_is_read_back_as_it_was_written",
    "rows/__init__.py": "test_acceptance.py::test_a_row_of_the_acceptance_table",
    "rows/alignment.py": "test_alignment_row.py::test_planted_offsets_are_judged",
    "rows/drone_block.py": "test_drone_block_row.py::test_the_row_renders_matches_and_judges",
    "rows/demo.py": "test_acceptance.py::test_a_row_of_the_acceptance_table",
    "rows/fresh.py": "test_seeds.py::test_the_figures_of_a_seed_are_those_of_its_surface",
    "rows/choice_of_images.py": "test_many_images.py::test_the_default_is_compared_with_the_best_of_the_others",
    "rows/location_grids.py": "test_location_grids_row.py::test_distances_of_cameras_that_differ_by_a_shift",
    "rows/many_images.py": "test_many_images.py::test_false_heights_on_ground_away_from_buildings_are_counted",
    "rows/methods.py": "test_acceptance.py::test_a_row_of_the_acceptance_table",
    "rows/ortho_images.py": "test_ortho_images_row.py::test_a_displaced_ortho_image_is_judged",
    "rows/photographs.py": "test_acceptance.py::test_a_row_of_the_acceptance_table",
    "rows/redo.py": "test_redo_row.py::test_changed_cells_and_mixtures_are_noticed",
    "rows/registry.py": "test_acceptance.py::test_a_row_of_the_acceptance_table",
    "rows/real_images.py": "test_real_images.py::test_a_row_judges_a_surface_by_the_image_that_was_left_out",
    "rows/rendered.py": "test_acceptance.py::test_a_row_of_the_acceptance_table",
    "rows/resources.py": "test_speed.py::test_the_benchmarks_of_the_kernels",
    "rows/self_calibration.py": "test_self_calibration_row.py::test_errors_are_given_by_their_stated_sigmas",
    "rows/satellite.py": "test_acceptance.py::test_a_row_of_the_acceptance_table",
    "same_pixels.py": "test_same_pixels.py::test_each_planted_difference_is_one_sentence",
    "seeds.py": "test_seeds.py::test_mean_spread_and_worst_of_several_seeds",
    "selection.py": "test_surfaces.py::test_the_benchmark_of_the_choice_of_views",
    "spaces.py": "test_surfaces.py::test_the_benchmark_of_object_and_image_space",
    "strecha.py": "test_strecha.py::test_the_script_writes_the_scene_turned_to_its_up",
    "terrain.py": "test_surfaces.py::test_the_benchmark_of_the_terrain",
    "terrain_features.py": "test_surfaces.py::test_the_benchmark_of_terrain_features",
    "threads.py": "test_speed.py::test_the_roofline_of_a_kernel_and_of_the_program",
    "rows/water.py": "test_water_row.py::test_lakes_are_judged_against_their_truth",
    "workplace.py": "test_acceptance.py::test_a_command_is_measured_and_its_failure_told",
}
# What has a command line of its own, by how it is called; the other files are parts of these, or are run by pytest.
COMMANDS = {
    path.name: path.stem for path in sorted(BENCHMARKS.glob("*.py")) if "ArgumentParser(" in path.read_text("utf-8")
} | {"pages": "pages.__main__", "peers": "peers.__main__"}


def test_every_script_is_run_by_a_test():
    """A new one needs a row above, and the test that the row names."""
    scripts = {path.relative_to(BENCHMARKS).as_posix() for path in BENCHMARKS.rglob("*.py")}
    assert scripts == RUN_BY.keys()
    for test in RUN_BY.values():
        module, name = test.split("::")
        assert f"\ndef {name}(" in (TESTS / "benchmarks" / module).read_text(encoding="utf-8"), test


def options_of(text: str) -> set[str]:
    return set(re.findall(r"(?<![\w-])--[a-z][a-z0-9-]*|(?<![\w-])-o\b", text))


@pytest.mark.parametrize("script", COMMANDS)
def test_the_page_says_how_a_script_is_called(script, monkeypatch, capsys):
    """With all the options that it has, and no other."""
    page = (BENCHMARKS / "README.md").read_text(encoding="utf-8").split("\n| script |")[0]
    lines = re.findall(rf"^    python benchmarks/{re.escape(script)}(?: .*)?$", page, re.MULTILINE)
    assert lines, f"benchmarks/README.md does not say how {script} is called"
    with pytest.raises(SystemExit):
        run_script(monkeypatch, importlib.import_module(COMMANDS[script]), "--help")
    usage = capsys.readouterr().out.split("\n\n")[0]
    assert options_of("\n".join(lines)) == options_of(usage.replace("[-o OUT]", "-o"))


def test_every_command_has_a_row_in_the_table_of_the_page():
    page = (BENCHMARKS / "README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`[^|]+`) \|", page.partition("\n| script |")[2].partition("\n\n")[0], re.MULTILINE)
    named = {name for row in rows for name in re.findall(r"`([^`]+)`", row)}
    assert named == COMMANDS.keys() | {path.name for path in BENCHMARKS.glob("bench_*.py")}
