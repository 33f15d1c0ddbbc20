"""What the messages of each topic hold, for the documentation: with units and frames."""

from __future__ import annotations

ABOUT = {
    'wheel_odometry': (
        'Where the wheels have base_link, in any frame of their own. stereo_camera publishes that '
        'of a recording.'
    ),
    'depth/image_raw': (
        'Depth aligned with the left image, 16UC1 (mm) or 32FC1 (m); taken instead of right '
        'images by parameter, or where nobody publishes those.'
    ),
    'imu': (
        'Angular velocity and acceleration, in a frame that tf ties to the camera. stereo_camera '
        'publishes those of a recording.'
    ),
    'cmd_vel': (
        'How to drive: linear.x in m/s, angular.z in rad/s; by parameter geometry_msgs/msg/Twist. '
        'With rate 0 its stamp is that of the image it answers.'
    ),
    'ground_truth': 'Where base_link truly is in world, at every image.',
    'contact': 'When the robot runs into something, where, in base_link (m).',
    'odometry': (
        'Every tracked frame: base_link in odom (continuous), with a covariance that grows as odom '
        'drifts, and the velocity with its own. Silent while lost.'
    ),
    'initialpose': (
        'About where base_link is in map, as RViz publishes it: the camera is looked for there.'
    ),
    'pose': (
        'Every tracked frame: base_link in map, with its covariance in the map around it. '
        'Published while subscribed to.'
    ),
    'odometry/corrected': (
        'For recordings: frames that came on odometry before the mount of the camera or the place '
        'in the map was known, corrected once.'
    ),
    'pose/corrected': 'The same for `pose`.',
    'dynamic_mask': (
        'mono8, 255 where something moves, of the left image that stereo_slam receives, with its '
        'stamp; from a segmentation network. Used when there, never waited for.'
    ),
    'moving_points': (
        'What moves, every few frames: x y z in map (m), vx vy vz (m/s, NaN where not known). '
        'Empty where nothing does.'
    ),
    'keyframe/moving_mask': (
        'mono8 on the rectified left image of the keyframe: 255 where something moves.'
    ),
    'keyframe/semantic_mask': (
        'mono8 on the rectified left image of the keyframe, what a network says of the floor: 255 '
        'floor, 0 stands in the way, 64 moves, 127 nothing.'
    ),
    'semantic_labels': (
        'mono8 on a left image as received: the class of each pixel by number, 255 for none.'
    ),
    'semantic_map': 'With each `map`, the number of the likeliest class of each cell, -1 for none.',
    'semantic_classes': 'JSON: the names of the classes by number, and what they stand for.',
    'frame_done': 'The header of every frame that SLAM has done with: tracked, skipped or refused.',
    'camera_mount': 'Left optical frame in base_link: given, from tf, or measured from the floor.',
    'keyframe/odometry': 'base_link in map at the keyframe.',
    'keyframe/map_start': (
        'The keyframe, and as time_ref when its map began: another time_ref is another map.'
    ),
    'map_file/loaded': (
        'What stereo_slam keeps of the nodes behind it, as the bytes of a map file: when one of '
        'them asks for it, and when a map is loaded.'
    ),
    'map_file/part': (
        'What a node knows of the map, as the bytes of a map file; from a node that does not know '
        'its map, the question for it.'
    ),
    'keyframe/features': (
        'Features of the keyframe: x y z in map (m, NaN where unknown), u v (px), id (-1: none).'
    ),
    'keyframe/path': (
        'base_link in map of all keyframes as now optimised; each pose with its own stamp.'
    ),
    'map_points': 'The whole sparse map: x y z in map (m) and id; a removed point disappears.',
    'keyframe/disparity': (
        'Disparity of the keyframe, 0 where there is no match. Published while subscribed to.'
    ),
    'keyframe/floor_mask': (
        'mono8 on the rectified left image: 255 floor, 127 no evidence, 0 not floor.'
    ),
    'keyframe/floor_overlay': (
        'bgr8, for people: the rectified left image tinted green for floor, blue for no evidence, '
        'red for not floor. Published while subscribed to.'
    ),
    'keyframe/v_disparity': (
        'bgr8, for people: the filtered v-disparity (rows: of the de-rolled image; columns: half '
        "pixels) and the floor's profile in green. Published while subscribed to."
    ),
    'keyframe/floor_scan': (
        "How far the floor was seen per bearing, in the base's plane (m); 0: blocked right in "
        'front, NaN: not seen. Intensities: distance of the nearest upright thing (m) or NaN.'
    ),
    'scan': (
        "How far the floor is free per bearing about ten times a second, in the base's plane (m), "
        'for a costmap to clear; inf: free to the end of the range, -inf: blocked right in front, '
        'NaN: not seen. Published while subscribed to.'
    ),
    'obstacle_scan': (
        'How far away something stands or walks per bearing about ten times a second, in the '
        "base's plane (m), for a collision monitor; inf: nothing within `range_max`, where the "
        'error is half a cell. Published while subscribed to.'
    ),
    'labelled_points': (
        'The sparse map with labels: x y z in map (m), id, confidence (0 to 1), label (0 unknown, '
        '1 floor, 2 obstacle).'
    ),
    'floor_points': 'The floor points alone: x y z id. Published while subscribed to.',
    'obstacle_points': (
        'Obstacle points of the newest keyframe with two neighbours within a cell, since the map '
        'may lack them: x y z id. Published while subscribed to: at every keyframe, again for '
        'each new subscriber, and empty twice a second in between while the camera is tracked. In '
        'a loaded map, its points until the first keyframe.'
    ),
    'keyframe/done': (
        'The header of every keyframe that goes no further: it is in the map, or a node could not '
        'process it.'
    ),
    'map': 'The map: 0 free to 100 occupied, -1 unknown; its stamp is that of the latest keyframe.',
    '/diagnostics': (
        'Status of the node; the header carries the stamp of the frame or keyframe it is about.'
    ),
}
"""By topic name."""

for _side in ('left', 'right'):
    _raw, _rect, _name = f'{_side}/image_raw', f'{_side}/image_rect', f'{_side.capitalize()} image'
    _packed = 'as JPEG or PNG; instead of'
    ABOUT |= {
        _raw: f'{_name}, raw.',
        f'{_raw}/compressed': f'{_name}, raw, {_packed} {_raw} by parameter.',
        _rect: f'{_name}, rectified; taken instead of {_raw} by parameter.',
        f'{_rect}/compressed': f'{_name}, rectified, {_packed} {_rect} by parameter.',
        f'{_side}/camera_info': f'Calibration for {_raw}.',
        f'keyframe/{_rect}': f'{_name} of the keyframe, rectified, mono8.',
        f'keyframe/{_side}/camera_info': f'Calibration for keyframe/{_rect}.',
        f'frame/{_rect}': 'Every tracked frame, rectified, some 240 pixels wide; published while '
        'subscribed to.',
        f'frame/{_side}/camera_info': f'Calibration for frame/{_rect}.',
    }
