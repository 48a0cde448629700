// A vision node beside the mirror: distances of what it detects in, focus requests out. It does in C++ what
// examples/vision_node.py does in Python, see docs/camera.md:
// ros2 run dm_example_cpp vision_node --ros-args -p rest_distance:=10.0

#include <cstdlib>
#include <memory>
#include <stdexcept>
#include <string>

#include "dm_msgs/msg/focus_request.hpp"
#include "dm_msgs/msg/focus_state.hpp"
#include "rclcpp/rclcpp.hpp"
#include "sensor_msgs/msg/range.hpp"

using dm_msgs::msg::FocusRequest;
using dm_msgs::msg::FocusState;
using sensor_msgs::msg::Range;

// 1/m; a distance (m) of 0 or inf means infinity, dioptre 0. Throws std::domain_error if it is negative or NaN.
double dioptre_of(double distance, const std::string & name)
{
  if (!(distance >= 0.0)) {
    throw std::domain_error(name + " = " + std::to_string(distance) + " m: must be above 0, or 0 or inf for infinity");
  }
  return distance > 0.0 ? 1.0 / distance : 0.0;
}

// Focuses on the latest `object_distance`, without waiting for anything.
class VisionNode : public rclcpp::Node
{
public:
  VisionNode()
  : Node("vision"),
    rest_dioptre_(dioptre_of(declare_parameter("rest_distance", 10.0), "rest_distance")),
    request_(create_publisher<FocusRequest>("focus_request", rclcpp::QoS(1))),  // reliable; the latest wins
    distance_(create_subscription<Range>(
        "object_distance", rclcpp::SensorDataQoS(), [this](const Range & seen) {on_distance(seen);})),
    state_(create_subscription<FocusState>(
        "focus_state", rclcpp::QoS(10), [this](const FocusState & state) {on_state(state);}))
  {
  }

private:
  void on_distance(const Range & seen)
  {
    FocusRequest request;
    try {
      // Of the surface: a mirror's power is twice its curvature.
      request.curvature = (dioptre_of(seen.range, "distance") - rest_dioptre_) / 2.0;
    } catch (const std::domain_error & error) {  // a detection that is no distance
      RCLCPP_WARN_THROTTLE(get_logger(), *get_clock(), 1000, "%s", error.what());
      return;
    }
    request.header.stamp = seen.header.stamp;  // a request that is too old is refused
    request_->publish(request);
  }

  void on_state(const FocusState & state)
  {
    if (state.error_code != 0) {
      RCLCPP_WARN_THROTTLE(get_logger(), *get_clock(), 1000, "refused: %s", state.message.c_str());
      return;
    }
    // Images stamped from then on show this focus.
    const double stands = state.header.stamp.sec + 1e-9 * state.header.stamp.nanosec + state.predicted_duration;
    RCLCPP_INFO(get_logger(), "%+.4f dioptre from %.3f s on", rest_dioptre_ + 2.0 * state.curvature, stands);
  }

  const double rest_dioptre_;  // 1/m, in focus while the mirror is flat
  const rclcpp::Publisher<FocusRequest>::SharedPtr request_;
  const rclcpp::Subscription<Range>::SharedPtr distance_;
  const rclcpp::Subscription<FocusState>::SharedPtr state_;
};

int main(int argc, char ** argv)
{
  rclcpp::init(argc, argv);
  try {
    rclcpp::spin(std::make_shared<VisionNode>());
  } catch (const std::exception & error) {  // a parameter of another type, or of no distance
    RCLCPP_ERROR(rclcpp::get_logger("vision"), "%s", error.what());
    return EXIT_FAILURE;
  }
  rclcpp::shutdown();
}
