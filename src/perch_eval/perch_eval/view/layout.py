"""The layout in which Foxglove shows a flight: scene, camera images, plots, diagnostics. Written to config/foxglove_layout.json.

    python3 -m perch_eval.view.layout > config/foxglove_layout.json
"""

from __future__ import annotations

import json

import foxglove.layouts as fl

WINDOW = 20.0  # width of the plots [s]


def _plot(title: str, unit: str, **series: str) -> fl.PlotPanel:
    paths = [fl.PlotSeries(value=path, label=name.replace("_", " "), enabled=True, timestamp_method="receiveTime") for name, path in series.items()]
    return fl.PlotPanel(title=title, config=fl.PlotConfig(
        paths=paths, y_axis_label=unit, show_legend=True, legend_display="floating", is_synced=True, x_axis_val="timestamp",
        time_window_mode="sliding", following_view_width=WINDOW))


def _image(camera: str) -> fl.ImagePanel:
    return fl.ImagePanel(title=f"{camera} camera", config=fl.ImageConfig(image_mode=fl.ImageModeConfig(
        image_topic=f"/camera_{camera}/image_raw/compressed", calibration_topic=f"/camera_{camera}/camera_info", rectify_image=False)))


def _scene() -> fl.ThreeDeePanel:
    return fl.ThreeDeePanel(title="scene", config=fl.ThreeDeeConfig(
        fixed_frame="map", follow_tf="map", follow_mode="follow-none",
        camera_state=fl.ThreeDeeCameraState(distance=9.0, phi=65.0, theta_offset=120.0, target_offset=(1.0, 0.0, 1.0), perspective=True),
        topics={"/markers": fl.BaseRendererRosMarkerTopicSettings(visible=True)},
        layers={"floor": fl.BaseRendererGridLayerSettings(visible=True, frame_id="map", size=10.0, divisions=10.0, label="1 m")}))


def layout() -> fl.Layout:
    """The layout."""
    position = {f"{name}_{axis}": f"/{topic}.pose.pose.position.{axis}"
                for axis in "xyz" for name, topic in (("estimated", "odometry"), ("true", "ground_truth/odometry"))}
    wanted = {f"wanted_{axis}": f"/controller/reference.pose.position.{axis}" for axis in "xyz"}
    rates = {f"w{axis}": f"/odometry.twist.twist.angular.{axis}" for axis in "xyz"}
    thrusts = {f"rotor_{k}": f"/rotor_state.thrust[{k}]" for k in range(4)}
    plots = [_plot("position", "m", **(position | wanted)), _plot("body rates", "rad/s", **rates), _plot("rotor thrusts", "N", **thrusts),
             _plot("controller", "m, -", position_error="/controller/status.position_error", thrust_margin="/controller/status.thrust_margin")]
    words = fl.RawMessagesPanel(title="controller", config=fl.RawMessagesConfig(topic_path="/controller/status.message", expansion="all"))
    diagnostics = fl.DiagnosticsSummaryPanel(title="diagnostics", config=fl.DiagnosticsSummaryConfig(topic_to_render="/diagnostics", min_level=0.0))

    def split(direction: str, *items: tuple[float, object]) -> fl.SplitContainer:
        return fl.SplitContainer(direction=direction, items=[fl.SplitItem(proportion=share, content=item) for share, item in items])

    left = split("column", (3.0, _scene()), (1.0, split("row", (1.0, words), (1.0, diagnostics))))
    images = split("row", (1.0, _image("front")), (1.0, _image("down")))
    return fl.Layout(content=split("row", (3.0, left), (2.0, split("column", (1.3, images), *((1.0, plot) for plot in plots)))))


def layout_json() -> str:
    """The layout as Foxglove imports it."""
    return json.dumps(json.loads(layout().to_json()), indent=1) + "\n"


if __name__ == "__main__":
    print(layout_json(), end="")
