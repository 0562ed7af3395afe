"""A web page with roslib that follows a robot, without ROS.

`RosbridgeServer` is to a page what rosbridge_server and tf2_web_republisher are: the page below would run unchanged
beside ROS. A robot drives in a circle; the page draws it, and says where its laser is in the map. If the connection
breaks, the page connects again and asks again, which roslib does not do by itself.

Run it with `pip install ".[rosbridge]"`, then `python demos/tf_in_page.py`, and open http://127.0.0.1:9090. The browser
loads roslib from the network. For the frames of other programs there is `tfbus rosbridge --page robot.html`.
"""

import math
import sys

import anyio

import tfbus
from tfbus.links.rosbridge import RosbridgeServer

PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>tf in a web page</title>
<script src="https://cdn.jsdelivr.net/npm/roslib@1.4.1/build/roslib.min.js" crossorigin="anonymous"
  integrity="sha384-TMOzJd1CZZp8+vowB0hoDe0HPrZ7kAWP5yp6cxooAFcjW+2cePLM8TrTOBW3elDg"></script>
<svg width="400" viewBox="-1.5 -1.5 3 3" role="img" aria-label="The robot in the map">
  <circle r="1" fill="none" stroke="gray" stroke-width=".01"/>
  <path id="robot" d="M.16 0 -.1 .1 -.05 0 -.1-.1Z" visibility="hidden"/>
</svg>
<p>laser in map: <output id="laser">not known yet</output>, <span id="state" role="status">connecting</span></p>
<script>
  const element = (id) => document.getElementById(id);
  const url = `ws://${location.host}`;
  const ros = new ROSLIB.Ros({ url });
  const tf = new ROSLIB.TFClient({ ros, fixedFrame: "map", rate: 20, transThres: 0.001, angularThres: 0.001 });
  tf.subscribe("base_link", ({ translation: { x, y }, rotation: { z, w } }) => {
    const heading = 2 * Math.atan2(z, w) * 180 / Math.PI;
    element("robot").setAttribute("transform", `translate(${x} ${-y}) rotate(${-heading})`);
    element("robot").setAttribute("visibility", "visible");
  });
  tf.subscribe("laser", ({ translation: { x, y, z } }) => {
    element("laser").textContent = [x, y, z].map((metres) => metres.toFixed(3)).join(", ");
  });
  ros.on("connection", () => { element("state").textContent = "live"; tf.updateGoal(); });
  ros.on("close", () => { element("state").textContent = "lost"; setTimeout(() => ros.connect(url), 500); });
</script>
</html>
"""


async def main(port: int = 9090) -> None:
    with tfbus.Bus() as bus:
        robot = tfbus.TransformBroadcaster(bus, authority="robot")
        robot.send_static("base_link", "laser", tfbus.Transform((0.1, 0.0, 0.2)))
        async with RosbridgeServer(bus, port, page=PAGE) as server:
            print(server.address.replace("ws:", "http:"), flush=True)
            async for tick in bus.clock.ticks(50.0):
                angle = 0.5 * tick / 50.0
                position = (math.cos(angle), math.sin(angle), 0.0)
                robot.send(
                    "map", "base_link", tfbus.Transform.from_axis_angle((0, 0, 1), angle + math.pi / 2, position)
                )


if __name__ == "__main__":
    anyio.run(main, int(sys.argv[1]) if sys.argv[1:] else 9090)
