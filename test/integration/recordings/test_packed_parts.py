"""A part that is compressed as a whole is no part that was never there."""

import gzip

from recordings import read, short_drive, to_sqlite

from graph_slam_ros.recordings.bag import open_bag


def folder_of_two(tmp_path):
    messages, _ = read(short_drive(tmp_path / "drive.mcap"))
    half, folder = len(messages) // 2, tmp_path / "bag"
    folder.mkdir()
    for k, some in enumerate((messages[:half], messages[half:])):
        next(to_sqlite(tmp_path / f"part_{k}", some).glob("*.db3")).rename(folder / f"bag_{k}.db3")
    second = folder / "bag_1.db3"
    (folder / "bag_1.db3.zstd").write_bytes(gzip.compress(second.read_bytes()))
    return folder, second


def test_a_part_that_is_still_packed_is_a_loss_with_the_command_that_unpacks_it(tmp_path):
    folder, second = folder_of_two(tmp_path)
    second.unlink()
    (loss,) = open_bag(folder).losses
    assert loss.startswith("bag_1.db3.zstd: not read: ")
    assert f"zstd -dc < {folder}/bag_1.db3.zstd > {second}" in loss


def test_a_packed_part_that_is_there_unpacked_too_is_no_loss(tmp_path):
    folder, _ = folder_of_two(tmp_path)
    assert open_bag(folder).losses == []
